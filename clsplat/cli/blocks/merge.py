# SPDX-License-Identifier: Apache-2.0
"""`clsplat blocks merge`: one model of the models of all blocks."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from clsplat.cli.blocks.city_runs import CityFolder
from clsplat.cli.options import Verb
from clsplat.cli.session import Services


@dataclass(frozen=True)
class BlocksMergeVerb(Verb):
    """Merge the models of all blocks into CITY/merged.ply.

    Each block gives the Gaussians whose means lie in its own cell. CITY/merged gets the mean appearance of each
    photograph over all blocks except the sky's, if appearances are learnt.
    """

    city: CityFolder
    """Folder with the trained blocks (clsplat blocks train)."""


def run(verb: BlocksMergeVerb, services: Services) -> int:
    """Merge the blocks, unless that has been done."""
    del services
    from clsplat.blocks.merging import merge
    from clsplat.blocks.progress_records import MERGED_FILE

    before = "" if merge(verb.city) else " (merged before)"
    print(f"merged model in {verb.city / MERGED_FILE}{before}", file=sys.stderr)
    return 0
