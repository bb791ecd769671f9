# SPDX-License-Identifier: Apache-2.0
"""Data of GPUs from data sheets and programming guides: limits of groups, and rates of the whole device."""

from __future__ import annotations

from dataclasses import dataclass

from gpu_compilers import Built


@dataclass(frozen=True)
class Architecture:
    """The limits of a unit that groups share: NVIDIA's SM, half of AMD's work-group processor or its compute unit.

    wave: items that run in step.
    waves, groups: maximum number of waves and groups at a time.
    registers, grain: number of 32-bit registers for all waves, allocated in multiples of `grain` per item.
    shared, reserved: bytes of shared memory, of which each group needs `reserved` for itself.
    """

    name: str
    wave: int
    waves: int
    groups: int
    registers: int
    grain: int
    shared: int
    reserved: int = 0


ARCHITECTURES = {
    "sm_75": Architecture("Turing", 32, 32, 16, 64 << 10, 8, 64 << 10),
    "sm_89": Architecture("Ada", 32, 48, 24, 64 << 10, 8, 100 << 10, 1 << 10),
    "sm_90": Architecture("Hopper", 32, 64, 32, 64 << 10, 8, 228 << 10, 1 << 10),
    "gfx90a": Architecture("CDNA 2", 64, 32, 16, 128 << 10, 8, 64 << 10),
    "gfx1030": Architecture("RDNA 2", 32, 32, 16, 64 << 10, 8, 64 << 10),
    "gfx1100": Architecture("RDNA 3", 32, 32, 16, 96 << 10, 24, 64 << 10),
}
"""Limits by target, from the CUDA programming guide (compute capabilities), AMD's ISA guides and LLVM's guide."""


@dataclass(frozen=True)
class Gpu:
    """A device.

    units: number of SMs or compute units.
    issue: number of wave instructions that a unit starts per cycle.
    ghz: boost clock.
    gb: memory bandwidth in GB/s.
    """

    name: str
    target: str
    units: int
    issue: int
    ghz: float
    gb: float

    @property
    def issued(self) -> float:
        """Maximum number of wave instructions that the device starts per millisecond."""
        return self.units * self.issue * self.ghz * 1e6


GPUS = (
    Gpu("RTX 2080 Ti", "sm_75", 68, 4, 1.545, 616),
    Gpu("RTX 3090", "sm_89", 82, 4, 1.695, 936),  # its own target would be sm_86
    Gpu("RTX 4090", "sm_89", 128, 4, 2.520, 1008),
    Gpu("H100 SXM", "sm_90", 132, 4, 1.980, 3350),
    Gpu("H200", "sm_90", 132, 4, 1.980, 4800),
    Gpu("RX 6800 XT", "gfx1030", 72, 2, 2.250, 512),
    Gpu("RX 7900 XTX", "gfx1100", 96, 2, 2.500, 960),
    Gpu("MI250, one of two", "gfx90a", 104, 1, 1.700, 1638),
)


REPORTED = {"H100 80GB HBM3": "H100 SXM"}
"""GPUs whose driver's name for them does not end in ours, by that ending."""


def gpu_of(device: str) -> Gpu | None:
    """The GPU that a driver's name of a device means; None if it is not among GPUS."""
    ours = next((name for ending, name in REPORTED.items() if device.endswith(ending)), device)
    return next((gpu for gpu in GPUS if ours.endswith(gpu.name)), None)


def waves_at_a_time(built: Built, items: int, more_shared: int = 0) -> int:
    """Number of a kernel's waves that fit in a unit. more_shared: bytes that a launch adds per group."""
    unit = ARCHITECTURES[built.target]
    waves = -(-items // unit.wave)
    a_wave = -(-max(built.registers, 1) // unit.grain) * unit.grain * unit.wave
    shared = built.shared + more_shared + unit.reserved
    groups = min(unit.groups, unit.waves // waves, unit.registers // a_wave // waves)
    if shared:
        groups = min(groups, unit.shared // shared)
    return groups * waves


def occupancy(built: Built, items: int, more_shared: int = 0) -> float:
    """Waves of a kernel that fit in a unit, as a fraction of the unit's maximum."""
    return waves_at_a_time(built, items, more_shared) / ARCHITECTURES[built.target].waves
