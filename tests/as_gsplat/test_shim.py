# SPDX-License-Identifier: Apache-2.0
"""`install_as_gsplat`: with gsplat, with an older one, and without; each in a process of its own, as modules stay."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from calls import python
from needs import require

require("torch")

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.needs("torch")

RENDER = """
import torch
def render(rasterization, **more):
    return rasterization(
        torch.tensor([[0.0, 0, 3]]), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 3), torch.ones(1), torch.ones(1, 3),
        torch.eye(4)[None], torch.tensor([[[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]]), 16, 16, **more)
"""


def run(code: str, *paths: Path, without: str = "") -> str:
    """Output of a program; `without` hides a package from it."""
    hide = f"import sys; sys.modules[{without!r}] = None\n" if without else ""
    path = os.pathsep.join([*map(str, paths), str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = python("-c", hide + RENDER + code, env={**os.environ, "PYTHONPATH": path}, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow  # as the next two: importing torch, each in a process of its own
@pytest.mark.needs("gsplat")
def test_a_program_that_has_imported_gsplat_already() -> None:
    out = run(
        """
import gsplat
from gsplat import rasterization, spherical_harmonics
from gsplat.rendering import rasterization as same
from gsplat.relocation import compute_relocation
from gsplat.strategy import ops
import clsplat.torch
names = clsplat.torch.install_as_gsplat()
for ours in ("rasterization", "spherical_harmonics", "quat_scale_to_covar_preci", "isect_tiles", "SelectiveAdam"):
    assert getattr(gsplat, ours) is getattr(clsplat.torch, ours), ours
assert rasterization is same is clsplat.torch.rasterization
assert compute_relocation is clsplat.torch.compute_relocation is ops.compute_relocation
assert ops.quat_scale_to_covar_preci is clsplat.torch.quat_scale_to_covar_preci
assert gsplat.rendering.isect_tiles is gsplat.cuda._wrapper.isect_tiles is clsplat.torch.isect_tiles
assert gsplat.rasterization_2dgs.__module__ == "gsplat.rendering"
assert gsplat.PngCompression.__module__ == gsplat.compression.__name__ + ".png_compression"
assert "__main__.rasterization" in names and "gsplat.strategy.ops.compute_relocation" in names
assert "gsplat.rasterization_2dgs" not in names
assert clsplat.torch.install_as_gsplat() == []
from clsplat.errors import InputError
from gsplat.cuda._wrapper import fully_fused_projection_with_ut, world_to_cam
for absent in (gsplat.rasterization_2dgs, gsplat.rendering.rasterization_2dgs, gsplat.proj, world_to_cam,
               fully_fused_projection_with_ut):
    try:
        absent(torch.zeros(1, 3), quats=None)
    except InputError as error:
        assert str(error).startswith(absent.__name__ + " is a CUDA function of gsplat that clsplat lacks"), error
    else:
        raise AssertionError(absent)
images, alphas, meta = render(rasterization)
print(tuple(images.shape), tuple(meta["radii"].shape))
"""
    )
    assert out == "(1, 16, 16, 3) (1, 2)\n"


@pytest.mark.slow
def test_a_program_where_there_is_no_gsplat() -> None:
    out = run(
        """
import clsplat.torch
clsplat.torch.install_as_gsplat()
import gsplat
from gsplat import rasterization, RollingShutterType
from gsplat.rendering import rasterization as same
from gsplat.cuda._wrapper import spherical_harmonics
from gsplat.relocation import compute_relocation
from gsplat.optimizers import SelectiveAdam
assert rasterization is same is clsplat.torch.rasterization
from gsplat import rasterization_2dgs, world_to_cam
from gsplat.rendering import rasterization_2dgs as same_2dgs
for absent in (rasterization_2dgs, same_2dgs, world_to_cam):
    try:
        absent(1, 2, 3)
    except clsplat.errors.InputError as error:
        assert str(error).startswith(absent.__name__ + " is a CUDA function of gsplat that clsplat lacks"), error
for name in ("DefaultStrategy", "PngCompression", "export_splats"):
    try:
        getattr(gsplat, name)
    except ImportError as error:
        assert str(error).startswith(name + " is part of gsplat, expected gsplat to be installed: pip"), error
try:
    from gsplat import nothing_of_this_name
except ImportError as error:
    assert "nothing_of_this_name" in str(error)
try:
    import gsplat.strategy
except ModuleNotFoundError as error:
    print(error)
try:
    clsplat.torch.MCMCStrategy
except ImportError as error:
    print(error)
assert clsplat.torch.install_as_gsplat() == []
print(gsplat.__version__, tuple(render(rasterization)[0].shape))
""",
        without="gsplat",
    )
    first, second, last = out.splitlines()
    assert first == "No module named 'gsplat.strategy'"
    assert "pip install --no-deps gsplat" in second
    assert last == "1.5.3 (1, 16, 16, 3)"


OLD = {
    "__init__.py": "from .rendering import rasterization\nfrom .version import __version__\n",
    "version.py": '__version__ = "1.4.0"\n',
    "rendering.py": "from .cuda._wrapper import isect_tiles\ndef rasterization(): ...\n",
    "cuda/__init__.py": "",
    "cuda/_wrapper.py": "def isect_tiles(): ...\ndef spherical_harmonics(): ...\n",
}


@pytest.mark.slow
def test_a_gsplat_that_has_one_radius_a_splat(tmp_path: Path) -> None:
    """The layout of 1.4: `radii` (C, N), or (nnz,); functions whose results have changed since stay its own."""
    for name, text in OLD.items():
        path = tmp_path / "gsplat" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")
    out = run(
        """
import gsplat
import clsplat.torch
clsplat.torch.install_as_gsplat()
assert gsplat.rendering.isect_tiles is not clsplat.torch.isect_tiles
assert gsplat.cuda._wrapper.spherical_harmonics is clsplat.torch.spherical_harmonics
for packed in (False, True):
    meta = render(gsplat.rasterization, packed=packed)[2]
    print(tuple(meta["radii"].shape), tuple(meta["means2d"].shape))
print(tuple(render(clsplat.torch.rasterization)[2]["radii"].shape))
try:
    clsplat.torch.DefaultStrategy
except Exception as error:
    print(error)
""",
        tmp_path,
    )
    assert out.splitlines()[:3] == ["(1, 1) (1, 1, 2)", "(1,) (1, 2)", "(1, 2)"]
    assert "DefaultStrategy" in out.splitlines()[3]


def test_without_torch_the_error_says_what_to_install() -> None:
    code = "import sys; sys.modules['torch'] = None; import clsplat.torch"
    done = python("-c", code, env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=300)
    assert "ModuleNotFoundError: clsplat.torch needs PyTorch: pip install 'clsplat[torch]'" in done.stderr
