#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Run gsplat's own tests of the functions that `clsplat.torch` replaces, on clsplat, at their full size.

git clone --branch v1.5.3 https://github.com/nerfstudio-project/gsplat DIR
python tools/ci/gsplat_tests.py --gsplat DIR
python tools/ci/gsplat_tests.py --gsplat DIR -k test_isect          # other arguments are pytest's

The files of `DIR/tests` are unchanged, except that the device is the CPU instead of cuda:0, and that the marks for
skipping without CUDA are removed. The tests compare with gsplat's code in PyTorch. Two parts of that code need CUDA and
are rewritten here in PyTorch: `rasterize_to_indices_in_range`, and nerfacc's two functions that sum along rays. Prints
the commit, and for each test how many cases passed, how many clsplat refused with an error that names the argument, and
how many failed. The exit status is 1 if one failed.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Generator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

CLAIMED = {
    "test_basic.py": (
        "test_quat_scale_to_covar_preci",
        "test_projection",
        "test_fully_fused_projection_packed",
        "test_isect",
        "test_rasterize_to_pixels",
        "test_sh",
    ),
    "test_rasterization.py": ("test_rasterization",),
    "test_strategy.py": ("test_strategy", "test_strategy_requires_grad"),
}
"""gsplat's tests that call only functions of `clsplat.torch`, keyed by file."""
AT_ONCE = 1 << 21
"""Number of (Gaussian, pixel) pairs in the reference's memory at a time."""
LEAST_ALPHA, LEAST_LIGHT = 1 / 255, 1e-4


class Report:
    """A plugin of pytest that seeds each test, and counts the tests' outcomes."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.counts: Counter[tuple[str, str]] = Counter()
        self.reasons: Counter[str] = Counter()

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self) -> None:
        """Seed the random numbers of gsplat's fixtures, which do not seed them."""
        torch.manual_seed(self.seed)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: Any, call: Any) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Count a test's outcome once."""
        report = yield
        if call.when == "call" or (call.when == "setup" and not report.passed):
            kind: str = report.outcome
            if call.excinfo is not None and call.excinfo.typename == "InputError":
                kind = "refused"
                self.reasons[str(call.excinfo.value)] += 1
            self.counts[item.originalname, kind] += 1
        return report


def main(arguments: list[str]) -> int:
    """Run the tests. Returns 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gsplat", type=Path, required=True, metavar="DIR", help="gsplat's sources, tag v1.5.3")
    parser.add_argument("--commit", help="of DIR, where it is no checkout")
    parser.add_argument("--seed", type=int, default=0, help="of what gsplat's fixtures draw")
    asked, others = parser.parse_known_args(arguments)
    folder = asked.gsplat.resolve()
    missing = [name for name in CLAIMED if not (folder / "tests" / name).is_file()]
    if missing:
        parser.error(f"{folder}: has no tests/{missing[0]}, expected gsplat's sources")
    sys.path.insert(0, str(folder))
    version = re.search(r'"(.+)"', (folder / "gsplat" / "version.py").read_text("utf-8"))
    print(f"gsplat {version[1] if version else '?'}, commit {asked.commit or commit_of(folder)}")
    _install()
    report = Report(asked.seed)
    with tempfile.TemporaryDirectory() as temporary:
        status = pytest.main([*_copied(folder, Path(temporary)), *others], plugins=[report])
    kinds = ("passed", "refused", "failed")
    for name in sorted({name for name, _ in report.counts}):
        print(f"{name}: {', '.join(f'{report.counts[name, kind]} {kind}' for kind in kinds)}")
    total = {kind: sum(count for (_, found), count in report.counts.items() if found == kind) for kind in kinds}
    print(f"all: {', '.join(f'{count} {kind}' for kind, count in total.items())}")
    for reason, count in report.reasons.items():
        print(f"refused {count} times: {reason}")
    return 1 if total["failed"] or not total["passed"] or status not in {0, 1} else 0


def commit_of(folder: Path) -> str:
    """The commit of a checkout; ? if the folder is not a checkout."""
    done = subprocess.run(
        ["git", "-C", str(folder), "rev-parse", "--show-toplevel", "HEAD"], capture_output=True, text=True, check=False
    )
    top, _, commit = done.stdout.strip().partition("\n")
    return commit if done.returncode == 0 and Path(top) == folder else "?"


def _copied(folder: Path, to: Path) -> list[str]:
    """Copy the test files, changed for the CPU, beside gsplat's data. Returns the identifiers of the tests to run."""
    (to / "tests").mkdir()
    (to / "assets").symlink_to(folder / "assets")
    (to / "pytest.ini").write_text("[pytest]\naddopts = -q -p no:cacheprovider\n", "utf-8")
    for name in CLAIMED:
        text = (folder / "tests" / name).read_text("utf-8")
        text = text.replace('torch.device("cuda:0")', 'torch.device("cpu")')
        text = re.sub(r"^@pytest\.mark\.skipif\(not torch\.cuda.*\n", "", text, flags=re.MULTILINE)
        (to / "tests" / name).write_text(text, "utf-8")
    return [
        f"--rootdir={to}",
        f"-c{to / 'pytest.ini'}",
        *(f"{to / 'tests' / name}::{test}" for name, tests in CLAIMED.items() for test in tests),
    ]


def _install() -> None:
    """Replace gsplat's CUDA functions by clsplat, and the CUDA parts of the reference."""
    import gsplat.cuda._torch_impl as reference
    import gsplat.cuda._wrapper as wrapper

    import clsplat.torch

    clsplat.torch.install_as_gsplat()
    wrapper.rasterize_to_indices_in_range = indices_in_range
    along_rays = ModuleType("nerfacc")
    along_rays.render_weight_from_alpha = weights_from_alphas  # type: ignore[attr-defined]
    along_rays.accumulate_along_rays = summed_along_rays  # type: ignore[attr-defined]
    sys.modules["nerfacc"] = along_rays
    reference.accumulate = in_pieces(reference.accumulate)


def in_pieces(accumulate: Callable[..., tuple[Tensor, Tensor]]) -> Callable[..., tuple[Tensor, Tensor]]:
    """gsplat's `accumulate`, called for about AT_ONCE pairs at a time, those of a pixel in one call.

    The gradient recomputes intermediate results to save memory.
    """

    def call(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, *ids: Any) -> tuple[Tensor, Tensor]:
        *pairs, width, height = ids
        _, pixels, images = pairs
        rays = images * (width * height) + pixels
        ends = torch.nonzero(rays[1:] != rays[:-1])[:, 0] + 1
        cuts, least = [0], AT_ONCE
        while least < len(rays) and (place := int(torch.searchsorted(ends, least))) < len(ends):
            cuts.append(int(ends[place]))
            least = cuts[-1] + AT_ONCE
        total: tuple[Tensor, Tensor] | None = None
        for begin, end in zip(cuts, [*cuts[1:], len(rays)], strict=True):
            piece = [each[begin:end] for each in pairs]
            arrays = (means2d, conics, opacities, colors)
            found = checkpoint(accumulate, *arrays, *piece, width, height, use_reentrant=False)
            total = found if total is None else (total[0] + found[0], total[1] + found[1])
        assert total is not None
        return total

    return call


def weights_from_alphas(alphas: Tensor, *, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """Weights of pairs, and the transmittance before each. Pairs are in the order of rays, and then front to back."""
    logs = torch.log1p(-alphas.double())
    before = torch.cumsum(logs, 0) - logs
    firsts = torch.searchsorted(ray_indices, torch.arange(n_rays, device=ray_indices.device))
    light = torch.exp(before - before[firsts[ray_indices]]).to(alphas.dtype)
    return light * alphas, light


def summed_along_rays(weights: Tensor, values: Tensor | None, *, ray_indices: Tensor, n_rays: int) -> Tensor:
    """(n_rays, D): sums of weighted values, or of the weights if there are no values."""
    rows = weights[:, None] if values is None else weights[:, None] * values
    return torch.zeros(n_rays, rows.shape[1], dtype=rows.dtype).index_add(0, ray_indices, rows)


def indices_in_range(
    range_start: int,
    range_end: int,
    transmittances: Tensor,
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gaussians, pixels and images of the pairs that contribute to the images, in order of images and pixels, front to
    back. range_start, range_end: the first and one past the last block of tile_size^2 Gaussians in each tile's list."""
    rows, columns = isect_offsets.shape[-2:]
    count, images = means2d.shape[-2], means2d.shape[:-2].numel()
    ends = torch.cat([isect_offsets.flatten(), torch.tensor([len(flatten_ids)])]).tolist()
    light = transmittances.detach().reshape(images, image_height, image_width)
    splats = [each.detach().reshape(images * count, *each.shape[means2d.dim() - 1 :]) for each in (means2d, conics)]
    covers = opacities.detach().reshape(-1)
    found: list[Tensor] = []
    block = tile_size * tile_size
    for index in range(images * rows * columns):
        begin = ends[index] + range_start * block
        end = min(ends[index + 1], ends[index] + range_end * block)
        if begin >= end:
            continue
        image, tile = divmod(index, rows * columns)
        row, column = divmod(tile, columns)
        y, x = torch.meshgrid(
            torch.arange(row * tile_size, min((row + 1) * tile_size, image_height)),
            torch.arange(column * tile_size, min((column + 1) * tile_size, image_width)),
            indexing="ij",
        )
        pixels = (y * image_width + x).flatten()
        left = light[image].flatten()[pixels]
        for first in range(begin, end, block):
            ids = flatten_ids[first : min(first + block, end)].long()
            delta = torch.stack([x.flatten(), y.flatten()], -1)[:, None] + 0.5 - splats[0][ids]  # (pixels, n, 2)
            a, b, c = splats[1][ids].unbind(-1)
            sigma = 0.5 * (a * delta[..., 0] ** 2 + c * delta[..., 1] ** 2) + b * delta[..., 0] * delta[..., 1]
            alpha = torch.clamp_max(covers[ids] * torch.exp(-sigma), 0.999)
            alpha = torch.where((sigma >= 0) & (alpha >= LEAST_ALPHA), alpha, 0)
            after = left[:, None] * torch.cumprod(1 - alpha, 1)
            pixel, place = torch.nonzero((alpha > 0) & (after > LEAST_LIGHT), as_tuple=True)
            found.append(torch.stack([ids[place] % count, pixels[pixel], torch.full_like(pixel, image)]))
            left = torch.where(after[:, -1] > LEAST_LIGHT, after[:, -1], 0)
            if not bool((left > 0).any()):
                break
    pairs = torch.cat(found, 1) if found else torch.zeros(3, 0, dtype=torch.int64)
    order = torch.argsort(pairs[2] * (image_width * image_height) + pairs[1], stable=True)
    gaussian, pixel, image = pairs[:, order]
    return gaussian, pixel, image


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
