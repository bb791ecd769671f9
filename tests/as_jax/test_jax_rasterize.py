# SPDX-License-Identifier: Apache-2.0
"""`clsplat.jax.rasterize` against the NumPy call, bit for bit, and against differences of its own images."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import python, refuses
from needs import require

import clsplat
from clsplat.device.context import Device

require("jax")
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402

import clsplat.jax  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
MODULE = sys.modules["clsplat.jax.rasterize"]
SIZE = {"width": 40, "height": 24}
ARRAYS = ("means", "quaternions", "scales", "opacities", "colors", "viewmats", "intrinsics", "backgrounds")


def cloud(count: int = 65, *, channels: int = 3, coefficients: int = 0) -> dict[str, Any]:
    """Arrays of a call with two cameras before a cloud of Gaussians."""
    random = np.random.default_rng(7)
    views = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    views[:, :3, 3] = [[0, 0, 4], [0.3, -0.2, 4.5]]
    lens = np.array([[40, 0, 20], [0, 42, 12], [0, 0, 1]], np.float32)
    values = (coefficients, 3) if coefficients else (channels,)
    arrays = {
        "means": random.uniform(-1, 1, (count, 3)),
        "quaternions": random.normal(size=(count, 4)),
        "scales": random.uniform(0.1, 0.3, (count, 3)),
        "opacities": random.uniform(0.1, 0.9, count),
        "colors": random.uniform(0.2, 0.8, (count, *values)),
        "viewmats": views,
        "intrinsics": np.tile(lens, (2, 1, 1)),
        "backgrounds": random.uniform(0, 1, (2, 3 if coefficients else channels)),
    }
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def weights(shape: tuple[int, ...]) -> Any:
    """A gradient by an array of this shape."""
    return np.random.default_rng(len(shape)).normal(size=shape).astype(np.float32)


def loss(arrays: dict[str, Any], **settings: Any) -> Any:
    """A weighted sum of images and alphas."""
    drawn = clsplat.jax.rasterize(**arrays, **SIZE, **settings)
    return sum(jnp.sum(image * weights(image.shape)) for image in (drawn.images, drawn.alphas))


def gradient(of: Any, *given: Any) -> Any:
    """The gradient by the first of the arguments, in one program: each operation by itself would be compiled too."""
    return jax.jit(jax.grad(of))(*given)


def by_numpy(arrays: dict[str, Any], **settings: Any) -> dict[str, Any]:
    """The gradients of that loss by the NumPy call."""
    drawn = clsplat.rasterize(**arrays, **SIZE, **settings)
    return drawn.vjp(weights(drawn.images.shape), weights(drawn.alphas.shape))  # type: ignore[union-attr]


CALLS = [
    ({"channels": 5}, {"render_mode": "RGB+ED", "rasterize_mode": "antialiased", "alpha_max": 0.999}),
    pytest.param({}, {}, marks=pytest.mark.slow),
    pytest.param({"coefficients": 4}, {"sh_degree": 1, "render_mode": "RGB+D"}, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("sizes", "settings"), CALLS)
def test_it_is_the_numpy_call_bit_for_bit(device: Device, sizes: dict[str, Any], settings: dict[str, Any]) -> None:
    arrays, settings = cloud(**sizes), {**settings, "device": device}
    expected = clsplat.rasterize(**arrays, **SIZE, **settings)

    def call(given: Any) -> Any:
        return clsplat.jax.rasterize(**given, **SIZE, **settings)

    for drawn in (call(arrays), jax.jit(call)(arrays)):
        for name, array in drawn._asdict().items():
            assert np.array_equal(array, getattr(expected, name)), name
    gradients = gradient(lambda given: loss(given, **settings), arrays)
    expected_gradients = by_numpy(arrays, **settings)
    for name in ARRAYS:
        assert np.array_equal(gradients[name], np.asarray(expected_gradients[name], np.float32)), name
        assert np.any(gradients[name]), name


def test_depth_alone_has_no_background(default_device: Device) -> None:
    arrays = {name: array for name, array in cloud().items() if name != "backgrounds"}
    settings = {"render_mode": "ED", "device": default_device}
    drawn = clsplat.jax.rasterize(**arrays, **SIZE, **settings)
    assert np.array_equal(drawn.images, clsplat.rasterize(**arrays, **SIZE, **settings).images)
    gradients, expected = gradient(lambda given: loss(given, **settings), arrays), by_numpy(arrays, **settings)
    assert all(np.array_equal(gradients[name], np.asarray(expected[name], np.float32)) for name in arrays)


def test_covariances_stand_for_quaternions_and_scales(default_device: Device) -> None:
    arrays = cloud()
    factors = np.random.default_rng(1).normal(0, 0.2, (65, 3, 3)).astype(np.float32)
    covars = factors @ factors.transpose(0, 2, 1)
    arrays |= {"quaternions": None, "scales": None, "covars": (covars + covars.transpose(0, 2, 1)) / 2}
    found = gradient(lambda covars: loss({**arrays, "covars": covars}, device=default_device), arrays["covars"])
    assert np.array_equal(found, by_numpy(arrays, device=default_device)["covars"])


STEPS = {"means": 2e-3, "viewmats": 2e-3, "scales": 1e-3, "intrinsics": 0.05}


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow) for name in ARRAYS[1:]] + ["means"])
def test_gradients_are_those_of_differences(default_device: Device, name: str) -> None:
    arrays, step = cloud(20), STEPS.get(name, 4e-3)

    @jax.jit
    def of_one(array: Any) -> Any:
        return loss({**arrays, name: array}, device=default_device)

    slope = np.asarray(gradient(of_one, arrays[name]))
    direction = slope / np.sqrt(np.mean(slope**2))
    there, back = (float(of_one(arrays[name] + sign * step * direction)) for sign in (1, -1))
    # along the gradient; alphas that cross the threshold of 1/255 are steps of the loss and not in the gradient
    assert (there - back) / (2 * step) == pytest.approx(float(np.vdot(slope, direction)), rel=0.05)


def test_results_beside_the_images_have_gradients(default_device: Device) -> None:
    arrays, names = cloud(), ("means2d", "depths", "conics")

    def of_splats(means: Any) -> Any:
        drawn = clsplat.jax.rasterize(**{**arrays, "means": means}, **SIZE, device=default_device)
        return sum(jnp.sum(weights(each.shape) * each) for each in (getattr(drawn, name) for name in names))

    expected = clsplat.rasterize(**arrays, **SIZE, device=default_device)
    d_splats = {name: weights(getattr(expected, name).shape) for name in names}
    assert np.array_equal(gradient(of_splats, arrays["means"]), expected.vjp_projection(**d_splats)["means"])


@pytest.mark.parametrize("absolute", [False, True])
def test_the_probe_has_the_gradient_by_means2d(default_device: Device, absolute: bool) -> None:
    arrays, settings = cloud(), {"device": default_device, "absolute_gradients": absolute}
    probe = np.zeros((2, 65, 2), np.float32)
    found = gradient(lambda probe: loss(arrays | {"means2d_probe": probe}, **settings), probe)
    expected = clsplat.rasterize(**arrays, **SIZE, **settings)
    pixels = expected.vjp_pixels(weights(expected.images.shape), weights(expected.alphas.shape))  # type: ignore[union-attr]
    assert np.array_equal(found, pixels["absolute" if absolute else "means2d"])


def test_a_pass_that_is_gone_is_made_again(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    arrays, call = cloud(), jax.jit(jax.grad(lambda given: loss(given, device=default_device)))
    kept = call(arrays)
    monkeypatch.setattr(MODULE, "_kept", MODULE.PendingForwards(0))
    again = call(arrays)
    assert all(np.array_equal(kept[name], again[name]) for name in ARRAYS)


def test_no_pass_stays_behind_its_gradient(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MODULE, "_kept", MODULE.PendingForwards(8))
    jax.block_until_ready(gradient(lambda given: loss(given, device=default_device), cloud()))
    clsplat.jax.rasterize(**cloud(), **SIZE, device=default_device).images.block_until_ready()
    assert not MODULE._kept._results


def test_arrays_may_go_before_their_gradient(default_device: Device) -> None:
    """The library reads arrays in place: JAX's own memory is another array's by then."""
    arrays = cloud()

    @jax.jit
    def call(given: Any) -> Any:
        given = {name: array * 1.0 for name, array in given.items()}  # arrays of the program, none of the caller's
        drawn, pull = jax.vjp(lambda given: loss(given, device=default_device), given)
        return pull(jnp.cos(drawn * 0))[0]

    expected = by_numpy(arrays, device=default_device)
    for _ in range(3):
        gradients = call(arrays)
        assert all(np.array_equal(gradients[name], np.asarray(expected[name], np.float32)) for name in ARRAYS)


def test_vmap_calls_it_for_each(default_device: Device) -> None:
    arrays = cloud()
    opacities = jnp.stack([arrays["opacities"], arrays["opacities"] / 2])
    of_one = jax.grad(lambda opacities: loss({**arrays, "opacities": opacities}, device=default_device))
    one_by_one = np.stack([jax.jit(of_one)(one) for one in opacities])
    assert np.array_equal(jax.jit(jax.vmap(of_one))(opacities), one_by_one)


@pytest.mark.parametrize("count", [0, *(pytest.param(count, marks=pytest.mark.slow) for count in (1, 63, 64))])
def test_counts(default_device: Device, count: int) -> None:
    arrays = cloud(count)
    drawn = clsplat.jax.rasterize(**arrays, **SIZE, device=default_device)
    assert np.array_equal(drawn.images, clsplat.rasterize(**arrays, **SIZE, device=default_device).images)
    gradients = gradient(lambda given: loss(given, device=default_device), arrays)
    assert np.array_equal(gradients["means"], by_numpy(arrays, device=default_device)["means"])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", np.zeros((65, 2)), r"means: got shape \(65, 2\), expected \(N, 3\)"),
        ("quaternions", np.zeros((65, 3)), r"quaternions: got shape \(65, 3\), expected \(65, 4\)"),
        ("colors", np.zeros(65), r"colors: got shape \(65,\), expected \(65, D\) or \(2, 65, D\)"),
        ("viewmats", np.eye(4)[:3], r"viewmats: got shape \(3, 4\), expected \(C, 4, 4\)"),
        ("backgrounds", np.zeros(4), r"backgrounds: got shape \(4,\), expected \(2, 3\)"),
        ("means", None, "means is None, expected an array"),
        ("scales", None, "scales is None, expected an array unless covars is given"),
        ("covars", np.zeros((65, 6)), "covars: expected either covars, or quaternions and scales"),
        ("colors", np.zeros((65, 0)), "colors has 0 channels, expected 1 or more"),
        ("render_mode", "depth", "render_mode is 'depth', expected one of RGB, D"),
        ("rasterize_mode", "smooth", "rasterize_mode is 'smooth', expected one of classic, antialiased"),
        ("camera_model", "lens", "camera_model is 'lens', expected one of pinhole"),
        ("near_plane", np.nan, "near_plane is nan, expected"),
        ("eps2d", -1, "eps2d is -1, expected"),
        ("alpha_max", 2.0, "alpha_max is 2.0, expected"),
        ("sh_degree", 7, "sh_degree is 7, expected a whole number from 0 to 4, or None"),
        ("width", [40, 20], r"width is \[40, 20\], expected a whole number"),
    ],
)
def test_an_argument_that_is_wrong_is_named_before_anything_runs(name: str, value: Any, message: str) -> None:
    refuses(message, jax.eval_shape, lambda: clsplat.jax.rasterize(**{**cloud(), **SIZE, name: value}))


def test_channels_beyond_one_pass_of_the_kernels_and_a_size_of_an_array(default_device: Device) -> None:
    arrays = {**cloud(), "colors": np.random.default_rng(2).random((65, 515), np.float32), "backgrounds": None}
    size = {"width": np.array(SIZE["width"]), "height": float(SIZE["height"])}
    drawn = clsplat.jax.rasterize(**arrays, **size, device=default_device)
    assert np.array_equal(drawn.images, clsplat.rasterize(**arrays, **SIZE, device=default_device).images)


def test_one_camera_and_one_background_as_numpy_takes_them(default_device: Device) -> None:
    arrays = {**cloud(), "backgrounds": np.array([0.1, 0.5, 0.9], np.float32)}
    both = clsplat.jax.rasterize(**arrays, **SIZE, device=default_device)
    assert np.array_equal(both.images, clsplat.rasterize(**arrays, **SIZE, device=default_device).images)
    arrays |= {name: arrays[name][0] for name in ("viewmats", "intrinsics")}
    one = clsplat.jax.rasterize(**arrays, **SIZE, device=default_device)
    assert np.array_equal(one.images, both.images[:1])
    found = jax.grad(lambda pose: clsplat.jax.rasterize(**{**arrays, "viewmats": pose}, **SIZE).images.sum())
    assert found(jnp.asarray(arrays["viewmats"])).shape == (4, 4)


def test_values_that_are_wrong_are_named_by_the_program() -> None:
    arrays = cloud()
    arrays["means"][3, 1] = np.nan
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"means: \[3, 1\] is nan, expected finite"):
        jax.jit(loss)(arrays).block_until_ready()


ON_ONE_CORE = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import clsplat.jax, jax, jax.numpy as jnp
given = jnp.full((100_000, 3), 0.5)
view, lens = jnp.eye(4)[None], jnp.eye(3)[None]
turns, opacities = jnp.ones((100_000, 4)), jnp.full(100_000, 0.1)
call = jax.jit(jax.grad(lambda colors: clsplat.jax.rasterize(
    given * 2, turns, given / 100, opacities, jnp.sin(colors), view, lens, 16, 16).images.sum()))
for _ in range(6):
    given = given + call(given).block_until_ready()
print("done")
"""


def run_python(code: str) -> subprocess.CompletedProcess[str]:
    """Code in a Python of its own."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return python("-c", code, env={**os.environ, "PYTHONPATH": path}, timeout=240)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no way to choose a core")
def test_one_core_does_not_wait_for_itself() -> None:
    done = run_python(ON_ONE_CORE)
    assert done.stdout == "done\n", done.stderr


def test_without_jax_the_error_says_where_to_get_it() -> None:
    done = run_python("import sys; sys.modules['jax'] = None; import clsplat.jax")
    assert done.stderr.splitlines()[-1].endswith("clsplat.jax needs JAX: pip install 'clsplat[jax]'")
