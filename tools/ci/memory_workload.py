#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Workload of `tools/ci/check_memory.py` in a child under Oclgrind: every kernel on scenes of a few tiles.

    memory_workload.py planted|LANESxITEMS [plain] [short] [PART]

Prints the name of each kernel and its build before the kernel runs. `plain`: with the replacements that the check of
uninitialised reads needs with Oclgrind 21.10 (`memory_stand_ins.py`).
`short`: with the smallest pictures and the fewest steps (`Extent.shorten`).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
from memory_library import library
from memory_scenes import EXTENT, camera, cloud, mostly_behind
from memory_stand_ins import stand_in
from numpy.typing import NDArray
from scipy.sparse import csr_array

from clsplat.bench.stages import _Picture
from clsplat.camera import Camera
from clsplat.chunks.order import ORDERED_ROWS
from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.config.training import DensityConfig, OptimiserConfig, TrainConfig
from clsplat.device import launch
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device, all_devices
from clsplat.device.drivers.shapes import Shape
from clsplat.device.program import Kernel
from clsplat.frame.deep import Merge
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians
from clsplat.images.holdouts import surfaces_of
from clsplat.layouts.columns import CHUNK_ROWS, POSE_ROWS, READBACK, WIDEST_SLOTS
from clsplat.optimisation.density_rules import MarkRules
from clsplat.rendering.rasterizer import ForwardPass, Rasterizer
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.dataset import Lens
from clsplat.scenes.scene import Scene
from clsplat.scenes.supervision.depth_samples import KnownDepth
from clsplat.selftest.case import Case, Inputs, faults
from clsplat.selftest.cases.table import CASES
from clsplat.stages import append as stages_append
from clsplat.stages import blend as stages_blend
from clsplat.stages import scan as stages_scan
from clsplat.stages.adam import add_view
from clsplat.stages.appearance import Gains, step_gains
from clsplat.stages.blend import count_pairs, tile_items
from clsplat.stages.density import DeviceMarker, DeviceRowList, carried, gather, new_statistics
from clsplat.stages.device_gaussians import DeviceGaussians, allocate_gaussians, host_gaussians, upload_gaussians
from clsplat.stages.peak import _splats
from clsplat.stages.probe_atomics import atomics_fault
from clsplat.training import moved_rows, trained_model
from clsplat.training.step import visible_chunks
from clsplat.training.step.visible_chunks import VisibleChunks
from clsplat.training.trainer import Trainer

PLANTED = """
__kernel void planted_bounds(__global float *out, const int n) { out[n + get_global_id(0)] = 1.0f; }
__kernel void planted_race(__global float *out) { out[0] = (float)get_global_id(0); }
__kernel void planted_uninitialised(__global float *out, __global const float *in) { out[0] = in[1] > 0.0f; }
"""
"""One fault of each kind that the check has to find. If it misses one, it fails."""


def image_gradient(device: Device, frame: ForwardPass) -> DeviceArray:
    """A random gradient with respect to a frame of the size EXTENT.frame: four planes, zero in the padding."""
    width, height = EXTENT.frame
    planes = np.zeros((4, *frame.blended.image.shape[1:]), np.float32)
    planes[:, :height, :width] = np.random.default_rng(1).normal(size=(4, height, width))
    return upload(device, planes)


def frames(device: Device) -> None:
    """Run forward and backward passes: as in training, with every exact switch off, and in bands.

    Also run the build of blending that counts pairs.
    """
    view = camera(*EXTENT.frame)
    gaussians, background = cloud(40, view), upload(device, np.array([0.1, 0.2, 0.3], np.float32))
    held = upload_gaussians(device, gaussians)
    names = [each.name for each in fields(BenchSwitches) if isinstance(each.default, bool)]
    switched: dict[str, Any] = {"tile_test": "square", "depth_sort": "pairs", "key_bits": "all"}
    all_off = BenchSwitches(**switched | dict.fromkeys(names, False))
    for config, small in ((RasterizerConfig(), False), (all_off, False), (RasterizerConfig(), True)):
        rasterizer = Rasterizer(device, config)
        if small:
            rasterizer.capacity = EXTENT.capacity
        frame = rasterizer.forward(held, view, background, nearness=True)
        if small and len(frame.bands) < 2:
            raise SystemExit("the frame in bands has one band only, expected several")
        gradients = allocate_gaussians(device, held.count, held.coefficients, zero=True)
        screen = rasterizer.backward(held, frame, image_gradient(device, frame), gradients, fields=WIDEST_SLOTS)
        arrays = [*(gradients[group] for group in PARAMETER_GROUPS), screen.gradients, frame.blended.image]
        read = [array.get() for array in arrays]
        shown = frame.projected.tile_counts.get() > 0
        if not all(np.isfinite(values[shown] if len(values) == len(shown) else values).all() for values in read):
            raise SystemExit("a gradient is not finite")
        if not small:
            count_pairs(
                rasterizer.device, rasterizer.work, frame.listed.lists, frame.projected.splats, background, frame.camera
            )


def subgroups(device: Device) -> None:
    """Run the probe of sub-groups, and the gradient of blending with and without them, in the shape's own groups.

    `frames` has so few tiles that its groups are larger. Shapes whose groups have one item have no sub-groups.
    Oclgrind has no sub-groups either: an item's own value replaces the one that it should get from another item. So the
    sums are wrong, but places and order of the writes are those of sub-groups of 8.
    """
    if device.shape.items == 1:
        return
    opened, rows = (device.with_shape(f"{device.shape.label}{way}") for way in ("s", ""))
    opened._subgroups.append({"SUBGROUP": 8, "EXCHANGED(x,step)": "(x)"})  # noqa: SLF001
    items = opened.shape.items
    out = allocate(opened, (3, items), np.float32)
    launch.launch_groups(opened, opened.kernels("probe_subgroup").probe_subgroup, 1, items, out)
    if not np.isfinite(out.get()).all():
        raise SystemExit("the probe of sub-groups is not finite")
    view = camera(*EXTENT.frame)
    for each in (opened, rows):
        each.max_group = items
        rasterizer, held = Rasterizer(each), upload_gaussians(each, cloud(40, view))
        frame = rasterizer.forward(held, view, upload(each, np.zeros(3, np.float32)), nearness=True)
        slots = rasterizer.pair_gradients(frame, image_gradient(each, frame), fields=WIDEST_SLOTS)
        if not np.isfinite(slots.values.get()).all():
            raise SystemExit("a sum by sub-groups or rows is not finite")


def long_lists(device: Device) -> None:
    """Run the gradient of blending on a list that is divided into several parts, one for each group.

    Parts are as short as the shape allows: a batch of pairs.
    """
    if device.shape.items == 1:
        return
    own, usual = device.with_shape(device.shape.label), stages_blend.PART_PAIRS
    own.max_group = own.shape.items
    stages_blend.PART_PAIRS = part = max(own.shape.items, 64)
    view = camera(9, 7)
    gaussians = cloud(4 * part, view, 2, degree=0)
    gaussians.opacity_logits[:] = np.linspace(-5, -2, len(gaussians), dtype=np.float32)  # no pixel becomes opaque
    rasterizer, held = Rasterizer(own), upload_gaussians(own, gaussians)
    frame = rasterizer.forward(held, view, np.zeros(3, np.float32), nearness=True)
    planes = np.random.default_rng(1).normal(size=(5, *frame.blended.stops.shape)).astype(np.float32)
    slots = rasterizer.pair_gradients(frame, upload(own, planes), fields=WIDEST_SLOTS).values.get()
    if not 2 * part < len(slots) or not np.isfinite(slots).all() or not slots[:, 0].any():
        raise SystemExit(f"the slots of a long list: {slots.shape}, expected finite ones of over {2 * part} pairs")
    stages_blend.PART_PAIRS = usual


def cases(device: Device) -> None:
    """Run the cases of single stages on a few rows or pixels, those with several builds several times."""
    for name, case in CASES.items():
        size = (17, 7) if isinstance(case.sizes[0], tuple) else 9
        twice = ("marks", "harmonics", "settle", "chunks", "catch_up")
        for draw in range({"adam": 3, **dict.fromkeys(twice, 2)}.get(name, 1)):
            given = case.random(np.random.default_rng([draw, *name.encode()]), size)
            if name == "adam":
                given.rows = ("all", "sparse", "late")[draw]
            given.all_rows = given.sparse = draw == 1  # inputs of the cases settle and chunks
            if name == "catch_up":
                given.rates = dict(sorted(given.rates.items())[: EXTENT.missed])
                given.last = {chunk: min(step, max(given.rates) - 1) for chunk, step in given.last.items()}
            check(f"{name}, {size}", case, device, given)
    gradients, sums = (allocate_gaussians(device, 9, 4, zero=True) for _ in range(2))
    shown = upload(device, np.arange(9, dtype=np.uint32) % 3)
    add_view(device, shown, gradients, sums)
    sums["means"].get()


def check(name: str, case: Case, device: Device, given: Inputs) -> None:
    """Run a case. Raises SystemExit if its errors exceed their bounds. name: for the message."""
    if wrong := faults(case.errors(device, given)):
        raise SystemExit(f"{name}: {', '.join(wrong)}")


def rendering(device: Device) -> None:
    """Run kernels that only rendering needs: fewer SH bands for some Gaussians, SH coefficients in half floats."""
    view = camera(*EXTENT.view)
    gaussians = cloud(27, view, 3)
    gaussians.sh[::2, 4:] = 0
    config = RasterizerConfig(sh_storage="half", sh_tolerance=0.05)
    Renderer(device, config=config).render(gaussians, view)


def pictures(device: Device) -> None:
    """Run kernels that only pictures need: channels beside colour, slices by depth, cameras without an image plane."""
    flat = camera(*EXTENT.picture)
    radius = flat.width / (2 * np.pi)
    around = replace(flat, fx=radius, fy=radius, projection="equirectangular")
    gaussians = cloud(30, flat, 6)
    for view in (flat, around, replace(around, fx=9.0, fy=9.0, projection="fisheye")):
        renderer = Renderer(device)
        motion = ("motion",) if view is flat else ()
        after = replace(view, translation=np.array([0.1, 0.0, 0.1]))
        _, found = renderer.render_channels(gaussians, view, ("normal", "position", *motion), after=after)
        slices = renderer.render_deep(gaussians, view, 3)
        halves = [np.full((view.height, view.width), part, np.float32) for part in (0.25, 0.75)]
        wall = np.full((view.height, view.width, 1), 2.5)
        renderer.render_channels(gaussians, view, holdout=surfaces_of(wall, 1.5 * wall, 0.2 * wall))
        several = Merge(renderer.device, 3)((slices.transpose(0, 3, 1, 2), half) for half in halves)
        if not all(np.isfinite(values).all() for values in (*found.values(), slices, several)):
            raise SystemExit(f"a channel of the {view.projection} camera is not finite")
        if not found["count"].any():
            raise SystemExit(f"the picture of the {view.projection} camera is empty")


PAPER = TrainConfig(
    iterations=6,
    sh_degree=2,
    sh_degree_every=2,
    warmup=(1,),
    density=DensityConfig(every=2, start=1, stop=6, gradient_threshold=1e-7, opacity_reset_every=3),
)
AHEAD = replace(PAPER, iterations=3, warmup=())


def training(device: Device) -> None:
    """Run steps with statistics of every kind, after which Gaussians are cloned, split and pruned. Also run steps by
    capacity, one of them with too small a capacity."""
    density = replace(PAPER.density, absolute_gradients=True, min_contribution=1e-3, prune_every=3, max_gaussians=60)
    wide = replace(PAPER, iterations=4, warmup=(), sh_degree=1, sh_degree_every=1, background="random")
    wide = replace(wide, optimiser=OptimiserConfig(sparse=True), density=density)
    _train(device, wide, 4, camera(*EXTENT.low))
    _train(device, AHEAD, 3, camera(*EXTENT.low))


def more_training(device: Device) -> None:
    """Run steps in which SH bands are added, the resolution doubles and opacities are reset. Also run steps with
    methods whose kernels `cases` runs too."""
    _train(device, PAPER, 3, camera(*EXTENT.view))
    low, short = camera(*EXTENT.low), replace(AHEAD, iterations=EXTENT.steps)
    _train(device, replace(short, appearance="ppisp"), 3, low)
    _train(device, replace(short, appearance="grid"), 3, low)
    _train(device, replace(short, masks="transparent"), 5, low)


def methods(device: Device) -> None:
    """Run steps with each method of training that has builds of its own, and with each kind of camera."""
    low, short = camera(*EXTENT.low), replace(AHEAD, iterations=EXTENT.steps)
    _train(device, replace(short, antialiased=True), 3, low)
    _train(device, replace(short, density=replace(PAPER.density, growth="mcmc", max_gaussians=60)), 3, low)
    _train(device, replace(short, appearance="exposure", masks="ignore"), 5, low)
    # A scene this small gives no matrix that pulls gains; here is one. Row 2 is the last row of the arrays.
    gains = Gains.on(device, np.zeros((3, 3), np.float32), csr_array(np.ones((3, 3))))
    columns, readback = upload(device, np.ones((3, 16), np.float32)), upload(device, np.zeros(len(READBACK), np.uint32))
    step_gains(device, gains, 2, columns, 1, 1e-3, readback)
    gains.logs.get()
    # Of three poses, two stay fixed. Sums over more than POSE_ROWS Gaussians take two kernels.
    refined = replace(short, refine_poses=True, refine_lenses=True, iterations=3)
    _train(device, refined, 3, low, views=3, count=POSE_ROWS + 1)
    _train(device, replace(short, depth="points"), 3, low)
    long = replace(PAPER.density, growth="budget", max_gaussians=60, long_axis=True)
    _train(device, replace(short, thinning=0.3, density=long), 3, low)
    fisheye = replace(low, fx=9.0, fy=9.0, projection="fisheye", radial=(0.05, 0.01, 0.0, 0.0))
    around = low.width / (2 * np.pi)
    panorama = replace(low, fx=around, fy=around, projection="equirectangular")
    for view in (fisheye, panorama, replace(low, fx=9.0, fy=9.0, projection="orthographic")):
        _train(device, short, 3, view)


def chunks(device: Device) -> None:
    """Run steps with a model of three chunks, one of which is in view. The other two then catch up."""
    for module in (visible_chunks, trained_model, moved_rows):
        vars(module)["ORDERED_ROWS"] = CHUNK_ROWS
    low, short = camera(*EXTENT.low), replace(AHEAD, iterations=EXTENT.steps)
    every = replace(PAPER.density, start=3, absolute_gradients=True, min_contribution=1e-3)
    for config, view in (
        (replace(short, density=every), low),
        (replace(short, thinning=0.3, optimiser=OptimiserConfig(sparse=True)), low),
        (replace(short, density=every, thinning=0.3), replace(low, fx=20.0, fy=20.0, projection="fisheye")),
    ):
        trainer = _train(device, config, 3, view, initial=mostly_behind(view))
        (component,) = (each for each in trainer.components if isinstance(each, VisibleChunks))
        steps = [
            0,
            0,
            0 if config.optimiser.sparse else config.iterations,
        ]  # sparse Adam misses no step, and notes none
        if component._last.tolist() != steps:  # noqa: SLF001
            raise SystemExit(f"last steps of the chunks: {component._last.tolist()}, expected {steps}")  # noqa: SLF001
        trainer.catch_up()
        trainer.parameters["means"].get()
    for module in (visible_chunks, trained_model, moved_rows):
        vars(module)["ORDERED_ROWS"] = ORDERED_ROWS


def _train(
    device: Device,
    config: TrainConfig,
    channels: int,
    view: Camera,
    views: int = 1,
    count: int = 18,
    initial: Gaussians | None = None,
) -> Trainer:
    pixels = np.random.default_rng(2).random((view.height, view.width, channels), np.float32)
    if channels == 3:
        pixels = (np.rint(255 * pixels) / np.float32(255)).astype(np.float32)  # such values go to the device as bytes
    if channels == 5:
        pixels[:, :, 4] = pixels[:, :, 4] > 0.3
    gaussians = cloud(count, camera(view.width, view.height), 5, degree=0)
    gaussians.opacity_logits[18:] = -9  # invisible: only their number matters, and blending them would take long
    trainer = Trainer(scene_of(view, pixels, views), config, device, initial or gaussians)
    trainer.pending.on = config is AHEAD
    if config is AHEAD:
        rooms = iter((0, 2000, 1))
        trainer.pending.room = lambda *_: next(rooms)  # type: ignore[method-assign]
    losses = [trainer.train_step().read()[0] for _ in range(config.iterations)]
    if trainer.pending.redone != (config is AHEAD):
        raise SystemExit(f"{trainer.pending.redone} steps were repeated, expected {int(config is AHEAD)}")
    if not np.isfinite(losses).all():
        raise SystemExit(f"the losses of a training are {losses}, expected finite numbers")
    return trainer


def scene_of(view: Camera, pixels: NDArray[np.float32], views: int = 1) -> Scene:
    """A scene of `views` equal views, whose picture is in memory. At a smaller size it is a part of the picture."""

    class Picture(_Picture):
        def load_sizes(self, sizes: Sequence[tuple[int, int]], *, reduce: bool = False) -> list[NDArray[np.float32]]:  # noqa: ARG002
            return [self.pixels[:height, :width] for width, height in sizes]

    lens = Lens("PINHOLE", view.width, view.height, (view.fx, view.fy, view.cx, view.cy))
    means = cloud(18, camera(view.width, view.height), 5, degree=0).means.astype(np.float64)
    depth = KnownDepth(means, np.ones(len(means)))  # for trainings that compare depths
    names = [f"{number}.png" for number in range(views)]
    pictures = [Picture(name, view, Path(name), "train", lens, depth=depth, pixels=pixels) for name in names]
    return Scene("tiny", list(pictures), np.zeros((0, 3)), np.zeros((0, 3), np.float32), (-np.ones(3), np.ones(3)))


def sorts(device: Device) -> None:
    """Run the radix sort and scans with several groups and passes."""
    rng, few = np.random.default_rng(4), stages_scan.MAX_SINGLE_CHUNK_ELEMENTS
    for alone, n, bits in ((few, 700, 20), (0, 2500, 13), (0, 77, 5), (few, 1, 1)):
        stages_scan.MAX_SINGLE_CHUNK_ELEMENTS = alone
        keys = rng.integers(0, 1 << bits, n).astype(np.uint32)
        check(f"sort of {n} keys", CASES["sort"], device, Inputs(keys=keys, bits=bits, base=0))
    check("scan", CASES["scan"], device, Inputs(values=np.ones(2100, np.uint32), in_place=True))  # more than one chunk
    stages_scan.MAX_SINGLE_CHUNK_ELEMENTS = few


def lists(device: Device) -> None:
    """Run lists by append that do not fit in local memory, boxes that a group shares, and the probe of atomics."""
    fits, stages_append.LOCAL_PAIRS = stages_append.LOCAL_PAIRS, 16
    rng = np.random.default_rng(2)
    check("lists by append", CASES["append"], device, CASES["append"].random(rng, 120))
    stages_append.LOCAL_PAIRS = fits
    check("list counts", CASES["list_counts"], device, CASES["list_counts"].random(rng, 70))
    if found := atomics_fault(device):
        raise SystemExit(f"the probe of atomics: {found}")


def density(device: Device) -> None:
    """Mark, list and gather rows of a model on the device, and of one on the host, which is processed in parts."""
    count = 3 * device.row_alignment + 1
    gaussians = cloud(count, camera(20, 17), 9, degree=1)
    statistics = new_statistics(device, count, contributions=True)
    statistics.load({name: np.linspace(0, 2, count, dtype=np.float32) for name in statistics.named()})
    rules = MarkRules(gradient=0.5, cut_off=(0.8, 9), large=-2.0, transparent=-5.0, contribution=0.01, radius=1.9)
    for model in (upload_gaussians(device, gaussians), host_gaussians(gaussians, device.row_alignment)):
        listed = DeviceMarker(device, Workspace(device), model, statistics).rows(rules)
        after = carried(device, Workspace(device), listed.rows, statistics.named(), densified=True)
        if isinstance(model, DeviceGaussians) and isinstance(listed, DeviceRowList):
            gather(device, listed.rows, model, renews=True)["means"].get()
        if not 0 < listed.halves < listed.count or not np.isinf(after.named()["whole_totals"].get()).any():
            told = f"{listed.halves} of {listed.count} rows are halves of splits"
            raise SystemExit(f"{told}, expected some but not all, and infinite totals of new rows")


def limits(device: Device) -> None:
    """Run a round of each kernel by which `clsplat bench` measures the device's limits, and the probes of the tests and
    of the self-test."""
    items, lanes = tile_items(device), device.shape.lanes
    copied = max(lanes, 4)
    splats, sums = upload(device, _splats()), allocate(device, (items,), np.float32)
    kernels = device.kernels("peak", {"ITEMS": items})
    for kernel in (kernels.limit_blend, kernels.limit_blend_grad):
        launch.launch_groups(device, kernel, 1, items, 2, splats, sums)
    sums.get()
    source, copy = upload(device, np.ones(16 * copied, np.float32)), allocate(device, (16 * copied,), np.float32)
    launch.launch_items(device, device.kernels("peak").limit_copy, 16, 16 * copied, source, copy)
    probe = device.kernels("probe")
    out = allocate(device, (5, 4), np.float32)
    launch.launch_grid(device, probe.probe_half, (5,), upload(device, np.arange(5, dtype=np.uint16)), out)
    out.get()
    copy.get()
    numbers = [upload(device, np.full(lanes, value, np.float32)) for value in (1.5, 2.5, -0.5)]
    results = allocate(device, (4, lanes), np.float32)
    launch.launch_items(device, device.kernels("arithmetic").arithmetic, 1, lanes, *numbers, results)
    results.get()


def planted(device: Device) -> None:
    """Run the faults of PLANTED, which Oclgrind has to find."""
    kernels = cl.Program(device.context, PLANTED).build(options=["-cl-std=CL1.2"])
    out, unwritten = allocate(device, (8,), np.float32), allocate(device, (8,), np.float32)
    for name, size, arguments in (
        ("planted_bounds", 1, (out.buffer, np.int32(8))),
        ("planted_race", 4, (out.buffer,)),
        ("planted_uninitialised", 1, (out.buffer, unwritten.buffer)),
    ):
        print(name, flush=True)
        getattr(kernels, name)(device.queue, (size,), (1,), *arguments)
        device.finish()


PARTS = {
    "training": (training,),
    "methods": (methods,),
    "chunks": (chunks,),
    "more": (more_training,),
    "library": (library,),
    "cases": (cases, sorts, lists),
    "passes": (limits, frames, subgroups, long_lists, rendering, pictures, density),
}
"""The workload in parts that take a child each, by name."""
WHOLE_ONLY = ("more",)
"""Parts that the short form leaves out. They may build nothing that no other part does."""


def build_of(kernel: Kernel) -> str:
    """A kernel and its build as one word: NAME@STEM,DEFINE,..."""
    variant = kernel.variant
    defines = [option.removeprefix("-D") for option in variant.options if option.startswith("-D")]
    return f"{kernel.name}@{','.join([variant.stem, *sorted(defines)])}"


def note_kernels() -> None:
    """Print name and build of each kernel before its launch, and wait for its end, so that a crash is that of the last
    kernel printed."""
    real = launch._enqueue  # noqa: SLF001

    def noted(
        device: Device, kernel: Kernel, size: tuple[int, ...], local: tuple[int, ...] | None, arguments: tuple[Any, ...]
    ) -> None:
        print(build_of(kernel), flush=True)
        real(device, kernel, size, local, arguments)
        device.finish()

    launch._enqueue = noted  # noqa: SLF001


def main(arguments: list[str]) -> int:
    """Run what the arguments say on Oclgrind's device."""
    note_kernels()
    device = next(each for each in all_devices() if "Oclgrind" in each.name)
    if arguments[0] == "planted":
        planted(Device(device, Shape(lanes=1, items=64, chunks=4)))
        return 0
    shape = Shape(1, 1, chunks=4).relabelled(arguments[0])
    if "plain" in arguments[1:]:
        if shape.lanes not in (1, 8):
            raise SystemExit(f"{shape.lanes} lanes: expected 1 or 8")
        stand_in(shape.lanes)
    if "short" in arguments[1:]:
        EXTENT.shorten()
    opened = Device(device, shape)
    print("probe_fma", flush=True)  # a device with lanes runs it before its first kernel, without `launch`
    if shape.items == 1:
        opened.kind = "cpu"  # so that kernels are launched as on a CPU
    for name in arguments[1:]:
        for part in PARTS.get(name, ()):
            part(opened)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
