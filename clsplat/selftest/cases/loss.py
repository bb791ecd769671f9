# SPDX-License-Identifier: Apache-2.0
"""Cases of the loss: L1 and SSIM with a photograph, the same with a mask and alpha, and the depth loss.

Self-test of the depth stage: the blended nearness (1 / depth), the depth loss, and the gradients of both.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from clsplat.arrays import Float32
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.layouts.columns import SLOT_PLAIN, SlotFields
from clsplat.reference import blend as reference_blend
from clsplat.reference.depth import depth_loss
from clsplat.reference.loss import alpha_loss, l1_dssim, masked_l1_dssim
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read, exactly
from clsplat.selftest.harness import MIN_DECISION_MARGIN, Array, CaseBench, StageOutcome, cropped, planes_of
from clsplat.selftest.scenes import evenly, padded
from clsplat.stages.blend import Blended, blend, blend_grad, tile_items
from clsplat.stages.device_camera import padded_size
from clsplat.stages.loss import Loss, loss
from clsplat.stages.loss_terms import AlphaTerm, DepthTerm, RenderTerms
from clsplat.stages.target import target

Size = tuple[int, int]

ALPHA_LOSS_WEIGHT = 0.5
"""Weight of the alpha loss in the tested sum of losses."""
MIN_LOSS_DIFFERENCE = 1e-6
"""Least difference between render and photograph, in alpha or colour, for a pixel's gradient to be compared. Below it,
rounding may change the gradient's sign."""
NEARNESS_SLOTS = SlotFields(nearness=True)
DEPTH_LOSS_FACTOR = 0.125
"""Factor of the depth loss in the tested sum of losses."""
MIN_NEARNESS_DIFFERENCE = 1e-5
"""Least difference between rendered and known nearness for a pixel's gradient to be compared. Below it, rounding may
change the gradient's sign."""


def random_pictures(rng: Generator, size: Size) -> tuple[Float32, Float32]:
    """Return a random render and a random photograph, (H, W, 3) each.

    The photograph is noise or of one colour, and may be dark. The render may be nearly equal to it. Half of the
    photographs have 8-bit values.
    """
    width, height = size
    y = rng.random((height, width, 3)) ** rng.choice([0.2, 1.0, 8.0])
    if rng.random() < 0.3:
        y[:] = rng.random(3)
    apart = 10 ** rng.uniform(-4, 0)
    x = np.clip(y + rng.normal(0, apart, y.shape), 0, 1.5)
    if rng.random() < 0.5:
        y = np.rint(y * 255).astype(np.uint8) * np.float32(1 / 255)
    return x.astype(np.float32), np.clip(y, 0, 1).astype(np.float32)


def _given(image: Float32, photograph: Float32, weight: float = 0.2) -> Inputs:
    return Inputs(image=image, photograph=photograph, weight=weight)


def _read(result: Loss, size: Size) -> Arrays:
    planes = result.gradient.get()[:, : size[1]]  # rows of padding are not written
    value, squared = result.read()
    return {
        "planes": planes,
        "gradient": cropped(planes, size)[:, :, :3],
        "beside": planes[:, :, size[0] :],
        "loss": np.array([value]),
        "squared error": np.array([squared]),
    }


def _launch(device: Device, work: Workspace, given: Inputs) -> Read:
    """Compute the loss with the photograph in planes, then with the interleaved photograph if the kernel reads it.

    "photograph" in the results is the number of other results that differ between the two.
    """
    size, background = given.size, upload(device, np.zeros(3, np.float32))
    image, photograph = (upload(device, planes_of(each)) for each in (given.image, given.photograph))
    first = _read(loss(device, work, image, photograph, size, given.weight), size)

    def again(source: Array) -> float:
        """Return the number of results that change if the kernel reads the interleaved photograph `source`."""
        as_loaded = target(device, work, source, background, in_planes=False)
        second = _read(loss(device, work, image, as_loaded, size, given.weight), size)
        return float(sum(np.count_nonzero(second[name] != first[name]) for name in first))

    levels = np.rint(given.photograph * 255).astype(np.uint8)
    exact = bool((levels * np.float32(1 / 255) == given.photograph).all())
    # With one item per tile the kernel reads planes only.
    sources = (given.photograph, levels)[: 1 + exact] if tile_items(device) > 1 else ()
    differing = [again(source) for source in sources]
    return lambda: {**first, "photograph": np.array([0.0, *differing])}


def _twin(given: Inputs, got: Arrays) -> dict[str, Expected]:
    x, y = given.wide("image", "photograph")
    value, gradient = l1_dssim(x, y, given.weight)
    squared = np.square(x - y).mean()
    return {
        # a difference of two pixels is off by 1e-7 of their brightness, which is at most 1.5
        "gradient": Expected(gradient, 1e-5),
        "beside": exactly(np.zeros_like(got["beside"])),
        "loss": Expected(np.array([value]), 1e-6, max(1.0, value)),  # the bound covers roundings of partial sums
        "squared error": Expected(np.array([squared]), 1e-5, squared),
        "photograph": exactly(np.zeros_like(got["photograph"])),
    }


LOSS_CASE = Case(
    # sizes around those of windows (11), vectors (16 columns), and blocks (32 rows, or 7 x 54 with a border of 5)
    sizes=(
        *((1, 1), (1, 40), (40, 1), (11, 11), (15, 17), (16, 5), (17, 33), (5, 16), (63, 40), (33, 65)),
        *((54, 7), (55, 8), (53, 6), (59, 12), (60, 13), (64, 2), (65, 14), (109, 9)),
    ),
    random=lambda rng, size: _given(*random_pictures(rng, size), float(rng.choice([0.0, 0.2, 0.2]))),
    launch=_launch,
    twin=_twin,
    frozen=lambda bench: [
        _given(cropped(bench.blended.image.get(), bench.camera), cropped(bench.frozen.photograph, bench.camera))
    ],
    digested=("planes",),
    own_bits_of_groups=True,
)


def _blended(device: Device, size: Size, image: Float32, left: Float32, nearness: Float32 | None = None) -> Blended:
    stops = np.full(padded_size(*size), -1, np.int32)
    stops[: size[1], : size[0]] = 0
    planes = (upload(device, planes_of(each[:, :, None])[0]) for each in (left, nearness) if each is not None)
    return Blended(upload(device, planes_of(image)), next(planes), upload(device, stops), None, next(planes, None))


def _random_masks(rng: Generator, size: Size) -> Inputs:
    x, y = random_pictures(rng, size)
    counts = (rng.random((*y.shape[:2], 1)) < rng.choice([0.0, 0.1, 0.5, 1.0])).astype(np.float32)
    counts[0, 0] = 1
    alpha = (rng.random(counts.shape) ** rng.choice([0.0, 1.0, 8.0])).astype(np.float32)
    left = (rng.random(y.shape[:2]) ** rng.choice([0.0, 1.0, 8.0])).astype(np.float32)
    photograph, background = np.concatenate([y, alpha, counts], axis=2), np.array([0.1, 0.5, 0.9], np.float32)
    return Inputs(image=x, left=left, photograph=photograph, background=background)


def _frozen_masks(bench: CaseBench) -> list[Inputs]:
    width, height = bench.camera.width, bench.camera.height
    photograph = evenly(35, (height, width, 5), 0.0, 1.0).astype(np.float32)
    photograph[:, :, 4] = 1
    photograph[: height // 2 + 3, : width // 2 + 5, 4] = 0
    image, left = (cropped(planes.get(), bench.camera) for planes in (bench.blended.image, bench.blended.transmittance))
    return [Inputs(image=image, left=left, photograph=photograph, background=bench.frozen.background)]


def _launch_masks(device: Device, work: Workspace, given: Inputs) -> Read:
    blended = _blended(device, given.size, given.image, given.left)
    planes = target(device, work, given.photograph, upload(device, given.background), blended, alpha=True)
    kept, further = int(given.photograph[:, :, 4].sum()), RenderTerms(blended, (AlphaTerm(ALPHA_LOSS_WEIGHT),))
    result = loss(device, work, blended.image, planes, given.size, 0.2, kept=kept, further=further)

    def read() -> Arrays:
        by_left = cropped(result.gradient.get(), given.size)[:, :, 3]
        masked = by_left[given.photograph[:, :, 4] == 0]
        return {**_read(result, given.size), "gradient by transmittance": by_left, "masked pixels": masked}

    return read


def _twin_of_masks(given: Inputs, got: Arrays) -> dict[str, Expected]:
    seen, left, parts, background = given.wide("image", "left", "photograph", "background")
    alpha, counts = parts[:, :, 3], parts[:, :, 4]
    truth = parts[:, :, :3] * alpha[:, :, None] + (1 - alpha)[:, :, None] * background
    value, gradient = masked_l1_dssim(seen, truth, counts)
    of_alpha, by_left = alpha_loss(left, alpha, counts, ALPHA_LOSS_WEIGHT)
    total, sure = value + of_alpha, (counts > 0) & (np.abs(seen - truth).min(axis=2) > MIN_LOSS_DIFFERENCE)
    return {
        # masked pixels are not compared, because the gradient of blending skips them
        "gradient": Expected(gradient, 1e-5, compared=sure),
        "gradient by transmittance": Expected(by_left, 1e-6, compared=np.abs(1 - left - alpha) > MIN_LOSS_DIFFERENCE),
        "masked pixels": exactly(np.zeros_like(got["masked pixels"])),
        # terms of SSIM cancel in windows with masked pixels
        "loss": Expected(np.array([total]), 1e-6, max(1.0, total, counts.size / counts.sum())),
    }


MASKS_CASE = Case(
    sizes=LOSS_CASE.sizes,
    random=_random_masks,
    launch=_launch_masks,
    twin=_twin_of_masks,
    frozen=_frozen_masks,
    digested=("planes",),
    own_bits_of_groups=True,
)


def _random_depths(rng: Generator, size: Size) -> Inputs:
    """Random nearness of 1e-6 to 1e6, with known values for some, all or none of the pixels."""
    image, _ = random_pictures(rng, size)
    scale = 10 ** rng.uniform(-6, 6)
    nearness, aims = (np.float32(scale) * rng.random(image.shape[:2]).astype(np.float32) for _ in range(2))
    weights = rng.random(aims.shape) * (rng.random(aims.shape) < rng.choice([0.0, 0.1, 1.0]))
    factor = float(10 ** rng.uniform(-3, 3) / scale)
    return Inputs(image=image, nearness=nearness, aims=aims, weights=weights.astype(np.float32), factor=factor)


def _launch_depth_loss(device: Device, work: Workspace, given: Inputs) -> Read:
    size = given.size
    blended = _blended(device, size, given.image, np.zeros_like(given.nearness), given.nearness)
    known = DepthTerm(planes_of(np.stack([given.aims, given.weights], axis=2)), given.factor)
    result = loss(device, work, blended.image, blended.image, size, 0.2, further=RenderTerms(blended, (known,)))
    return lambda: {
        "gradient": cropped(result.gradient.get(), size)[:, :, 3],
        "loss": np.array([result.read()[0]]),
    }


def _twin_of_depth_loss(given: Inputs, _: Arrays) -> dict[str, Expected]:
    nearness, aims, weights = given.wide("nearness", "aims", "weights")
    value, gradient = depth_loss(nearness, aims, weights, given.factor)
    return {
        "gradient": Expected(gradient, 3e-7, np.abs(gradient)),  # the bound covers one rounding of a product
        # The two pictures are equal, so the loss is the depth term alone.
        "loss": Expected(np.array([value]), 1e-6, max(1.0, value)),
    }


DEPTH_LOSS_CASE = Case(
    sizes=LOSS_CASE.sizes[:7],
    random=_random_depths,
    launch=_launch_depth_loss,
    twin=_twin_of_depth_loss,
)


def of_depth(bench: CaseBench) -> StageOutcome:
    """Test the nearness of the scene, and the depth loss with synthetic known depths. A quarter of them is missing.

    The digest leaves out the gradients of pairs, because the order of their sums depends on the kernel shape.
    """
    device, camera = bench.device, bench.camera
    height, width = camera.height, camera.width
    planes = padded(camera, 36, 0.0, 0.5)[:2].astype(np.float32)
    planes[1][planes[1] < 0.125] = 0.0
    aims, photograph = DepthTerm(planes, DEPTH_LOSS_FACTOR), upload(device, bench.frozen.photograph)

    def launch() -> tuple[Blended, Loss]:
        blended = blend(device, bench.work, bench.lists, bench.inputs, nearness=True)
        pictures, further = (blended.image, photograph), RenderTerms(blended, (aims,))
        return blended, loss(device, bench.work, *pictures, (width, height), 0.2, further=further)

    def take(made: tuple[Blended, Loss]) -> list[Array]:
        assert made[0].nearness is not None
        return [cropped(made[0].nearness.get(), camera), cropped(made[1].gradient.get(), camera)[:, :, 3]]

    made, outcome = bench.twice(launch, take)
    nearness, gradient = outcome.arrays
    splats = bench.splats()
    known, weights = (cropped(plane, camera).astype(np.float64) for plane in planes)
    background = bench.frozen.background.astype(np.float64)
    seen = reference_blend.blend(splats, width, height, background)
    clear = seen.margin > MIN_DECISION_MARGIN
    _, by_nearness = depth_loss(seen.nearness, known, weights, DEPTH_LOSS_FACTOR)
    sure = clear & (np.abs(seen.nearness - known) > MIN_NEARNESS_DIFFERENCE)
    by_pixel = np.where(clear, evenly(37, (height, width), -0.5, 0.5), 0.0)
    four = np.zeros((4, *planes.shape[1:]), np.float32)
    four[3, :height, :width] = by_pixel
    slots = _slots_of_depth(bench, made[0], upload(device, four))
    by_near, nothing = four[3, :height, :width].astype(np.float64), np.zeros((height, width, 3))
    wanted = reference_blend.blend_grad(splats, width, height, background, nothing, d_nearness=by_near)
    shown = splats.visible
    return outcome.compared(
        {
            "nearness": (nearness[clear], seen.nearness[clear]),
            "gradient": (gradient[sure], by_nearness[sure]),
            "gradient by one over the depth": (slots[shown, SLOT_PLAIN], wanted.nearness[shown]),
            "sum of g": (slots[shown, 0], (wanted.opacities * splats.opacities)[shown]),
        }
    )


def _slots_of_depth(bench: CaseBench, blended: Blended, gradient: DeviceArray) -> Array:
    """Launch the gradient of blending, and return the float64 sums (n, columns) of each Gaussian's slots."""
    lists, pixels = bench.lists, (bench.inputs, blended, gradient)
    slots = blend_grad(bench.device, bench.work, lists, *pixels, fields=NEARNESS_SLOTS).get()
    sums = np.zeros((bench.model.count, NEARNESS_SLOTS.floats))
    np.add.at(sums, lists.gaussian_from_sorted.get(), slots[lists.slot_from_sorted.get()].astype(np.float64))
    return sums
