# SPDX-License-Identifier: Apache-2.0
"""`clsplat devices`: the OpenCL devices of this machine."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Annotated

from tyro.conf import arg

from clsplat.cli.options import Flag, Verb
from clsplat.cli.session import Services, chosen_devices
from clsplat.progress import aligned


@dataclass(frozen=True)
class Devices(Verb):
    """List the OpenCL devices."""

    device: Annotated[str | None, arg(metavar="DEVICE")] = None
    """List only the one that this names, as other verbs' --device does: an index, cpu, gpu, or a part of a name.
    If not given: all of them."""
    json: Flag = False
    """Print a JSON array instead of the table."""


def run(verb: Devices, _: Services) -> int:
    """Print the table of devices."""
    devices = chosen_devices(verb.device)
    if verb.json:
        print(json.dumps([asdict(info) for info in devices], indent=2))
        return 0
    rows = [("", "name", "kind", "units", "memory", "platform", "version", "shape")]
    for info in devices:
        memory = f"{info.memory_bytes / 2**30:.1f} GiB"
        version = info.version.split("  ")[0]  # PoCL lists its build options after two spaces
        words = (info.name, info.kind, str(info.compute_units), memory, info.platform, version, info.shape)
        rows.append((str(info.index), *words))
    print("\n".join(aligned(rows, left=range(len(rows[0])))))
    return 0
