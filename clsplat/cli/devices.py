# SPDX-License-Identifier: Apache-2.0
"""`clsplat devices`: table of this machine's OpenCL devices."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Annotated

from tyro.conf import arg

from clsplat.cli.options import Flag, Verb
from clsplat.cli.session import Services, chosen_devices
from clsplat.progress import aligned


@dataclass(frozen=True)
class DevicesVerb(Verb):
    """List the OpenCL devices."""

    device: Annotated[str | None, arg(metavar="DEVICE")] = None
    """List only this device, named as for other verbs' --device: an index, cpu, gpu, or part of a name. If not given:
    all devices."""
    json: Flag = False
    """Print a JSON array instead of the table."""


def run(verb: DevicesVerb, _: Services) -> int:
    """Print the table of devices."""
    devices = chosen_devices(verb.device)
    if verb.json:
        print(json.dumps([asdict(info) for info in devices], indent=2))
        return 0
    rows = [("", "name", "kind", "units", "memory", "platform", "version", "shape")]
    for info in devices:
        memory = f"{info.memory_bytes / 2**30:.1f} GiB"
        version = info.version.split("  ")[0]  # PoCL's version ends in two spaces and its build options
        words = (info.name, info.kind, str(info.compute_units), memory, info.platform, version, info.shape)
        rows.append((str(info.index), *words))
    print("\n".join(aligned(rows, left=range(len(rows[0])))))
    return 0
