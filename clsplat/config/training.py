# SPDX-License-Identifier: Apache-2.0
"""Settings of the rasterizer and of training, each default once: these dataclasses are the command line, the
`config.toml` and the help. What several verbs, or a verb and the package, have beside them has its default here too.

The training defaults are those of the paper's authors' 2024 code, with the paper's resolution warm-up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from math import inf
from numbers import Integral, Real
from typing import Literal, get_args, get_origin, get_type_hints

from clsplat.errors import InputError

Background = Literal["black", "white", "random"]
Preset = Literal["exact", "default", "fast"]
Schedule = Literal["paper", "short"]
Growth = Literal["paper", "budget"]
Parts = Literal["one", "several"]
ExrDepth = Literal["half", "float"]
EXR_DEPTH: ExrDepth = "float"
TEST_EVERY = 8
HOST, PORT = "127.0.0.1", 8080
"""Where the viewer listens."""
Compression = Literal["none", "rle", "zips", "zip", "piz", "pxr24", "dwaa", "dwab"]

MOST = 1 << 62
"""Below which whole numbers are, so that TOML has room for them."""

_Rule = tuple[tuple[str, ...], Callable[[float], bool], str]
"""Names of settings, whether a value makes sense (which NaN must not), and what is expected."""


def _check(config: object, prefix: str, rules: tuple[_Rule, ...]) -> None:
    """Raise InputError naming the flag of the first setting that breaks its rule."""
    for names, makes_sense, expected in rules:
        for name in names:
            value = getattr(config, name)
            if not makes_sense(value):
                raise InputError(f"{prefix}{name.replace('_', '-')} {value}: expected {expected}")


def _check_kinds(config: object, prefix: str) -> None:
    """Raise InputError naming the flag of the first setting that is of another kind than its field, which Python lets
    through, or larger than config.toml can hold."""
    for name, kind in get_type_hints(type(config)).items():
        value = getattr(config, name)
        if get_origin(kind) is Literal:
            fits, expected = isinstance(value, str) and value in get_args(kind), f"one of {', '.join(get_args(kind))}"
        elif get_origin(kind) is tuple:
            fits = isinstance(value, tuple | list) and all(_is_whole(step) for step in value)
            expected = f"whole numbers below {MOST}"
        elif kind is int:
            fits, expected = _is_whole(value), f"a whole number below {MOST}"
        elif kind is float:
            fits = isinstance(value, Real) and not _is_truth(value) and not 1e300 <= abs(float(value)) < inf
            expected = "a number below 1e300"
        else:
            fits = _is_truth(value) if kind is bool else isinstance(value, kind)
            expected = "True or False" if kind is bool else f"{kind.__name__}(...)"
        if not fits:
            text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
            raise InputError(f"{prefix}{name.replace('_', '-')} {text:.100}: expected {expected}")


def _is_truth(value: object) -> bool:
    return type(value).__name__ in ("bool", "bool_")  # NumPy's has had both names


def _is_whole(value: object) -> bool:
    return isinstance(value, Integral) and not _is_truth(value) and abs(int(value)) < MOST


def _check_steps(flag: str, steps: tuple[int, ...]) -> None:
    """Raise InputError unless the steps are from 1 up and in order."""
    if any(step < 1 for step in steps) or list(steps) != sorted(set(steps)):
        raise InputError(f"{flag} {','.join(map(str, steps))}: expected steps from 1 up, in order")


@dataclass(frozen=True)
class RasterizerConfig:
    """What the rasterizer skips. Only settings that are marked as approximate change a picture; the others change no
    bit of a frame, and are there to be measured.

    sh-tolerance and sh-storage are of frames of a model that is held on the device (render, eval), not of training.
    docs/performance.md has the error of each setting, and the time that it buys.
    """

    extent: Literal["opacity", "constant", "3sigma"] = "opacity"
    """How far a Gaussian reaches. opacity: to where its alpha is alpha-min; constant: as far as an opaque one would,
    whatever its opacity; 3sigma: three standard deviations, which cuts what is visible of opaque ones (approximate)."""
    tile_test: Literal["ellipse", "box", "square"] = "ellipse"
    """In which tiles of 16 x 16 pixels a Gaussian is listed. ellipse: those that its ellipse reaches, or all of its
    bounding box where that has at most 16; box: all of its bounding box; square: those that the square of its longest
    half axis reaches, as in the code of Kerbl et al."""
    depth_sort: Literal["visible", "pairs"] = "visible"
    """What is sorted. visible: the visible Gaussians by depth, then their pairs with tiles, stably, by tile; pairs: all
    pairs by tile and depth, as in the code of Kerbl et al."""
    key_bits: Literal["needed", "all"] = "needed"
    """Which bits are sorted by. needed: those in which the depths of the frame and its tiles differ; all: 32 of
    each."""
    row_skip: bool = True
    """Visit only the rows of a tile that a Gaussian's bounding box reaches."""
    column_skip: bool = True
    """Visit only the vectors (pixels that are worked on at once) of a row that a Gaussian's bounding box reaches."""
    vector_skip: bool = True
    """Leave a vector of pixels when the Gaussian contributes to none of them. Frames on a CPU have no use for it: their
    vectors are found by the ellipse, so that few are visited in vain."""
    early_stop: bool = True
    """Leave a tile when all its pixels are opaque; else go on to its last Gaussian, to no effect."""
    last_contributor: bool = True
    """A tile's gradient begins at the last Gaussian that one of its pixels takes, or at its last, to no effect."""
    record_cells: bool = True
    """A tile's gradient visits the cells of pixels in which a Gaussian contributes, as blending has recorded them; else
    it finds those that the ellipse reaches once more."""
    gradient_skip: bool = True
    """A tile's gradient leaves out the recorded cells in which no pixel has one."""
    frustum_cull: bool = True
    """Leave out a Gaussian that reaches no tile of the image before its colour is worked out; else it has a colour and
    a place in the order of depth, to no effect. What is not in front of the near plane has no projection, and is always
    left out."""
    opacity_cull: bool = True
    """Leave out a Gaussian whose opacity is not over alpha-min before its colour is worked out; else as with
    frustum-cull off, wherever it lies: it has no extent."""
    sh_degree_limit: int = 3
    """Leave out the bands of spherical harmonics (SH, colour by direction) above this degree, 0 to 3 (approximate)."""
    sh_tolerance: float = 0.0
    """Leave out a Gaussian's highest SH bands as long as that changes no channel of its colour, 0 to 1, by more than
    this, from any direction: 0 leaves out those that are zero (approximate above 0). Bands that none needs are always
    left out, those that some need only where that is half of all coefficients: from there on it pays."""
    sh_storage: Literal["float", "half"] = "float"
    """Keep the SH bands above 0 in 32 or in 16 bits (half is approximate, of half the memory)."""
    alpha_min: float = 1 / 255
    """Skip a Gaussian at a pixel where its alpha is less than this (approximate above the default, 1/255: one step of 8
    bits)."""
    transmittance_min: float = 1e-4
    """A Gaussian that would take a pixel's transmittance to this or less is left out and ends the pixel (approximate
    above 1e-4)."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value makes no sense."""
        rules: tuple[_Rule, ...] = (
            (("sh_degree_limit",), lambda value: 0 <= value <= 3, "0 to 3"),
            (("sh_tolerance",), lambda value: 0 <= value <= 1, "0 to 1"),
            (("alpha_min",), lambda value: 1e-3 <= value < 0.5, "0.001 to 0.5"),
            (("transmittance_min",), lambda value: 1e-6 <= value < 0.5, "1e-6 to 0.5"),
        )
        _check_kinds(self, "--rasterizer.")
        _check(self, "--rasterizer.", rules)


DEMO_ITERATIONS = 2000
"""Steps of `clsplat demo`, about a minute of two cores."""

PRESETS: dict[Preset, RasterizerConfig] = {
    "exact": RasterizerConfig(),
    "default": RasterizerConfig(),
    "fast": RasterizerConfig(alpha_min=2 / 255, transmittance_min=1e-3),
}
"""exact: nothing approximate; default: what is on unless asked for, equal to exact as long as every default has an
error of zero; fast: approximations that are worth their error (docs/performance.md)."""


@dataclass(frozen=True)
class OptimiserConfig:
    """Learning rates and Adam's constants, a rate per parameter group."""

    means_rate: float = 1.6e-4
    """Learning rate of the Gaussians' middles (means) at the first step, in parts of the scene's extent."""
    means_rate_end: float = 1.6e-6
    """Learning rate of the means from means-rate-steps on, in parts of the extent; until then it falls to this by the
    same factor every step."""
    means_rate_steps: int = 30_000
    """Steps over which the learning rate of the means falls."""
    sh_dc_rate: float = 2.5e-3
    """Learning rate of colours: the constant band of the spherical harmonics."""
    sh_rest_rate: float = 2.5e-3 / 20
    """Learning rate of what colours have by direction: the higher bands of the spherical harmonics."""
    opacities_rate: float = 0.025
    """Learning rate of the opacities, as logits."""
    scales_rate: float = 5e-3
    """Learning rate of the sizes, as logarithms."""
    quaternions_rate: float = 1e-3
    """Learning rate of the rotations, as quaternions."""
    sparse: bool = False
    """Leave Gaussians that a step's view does not show as they are, Adam's moments too (approximate)."""
    sh_rest_every: int = 1
    """Update the higher SH bands in every so many steps (approximate above 1)."""
    cooldown: int = 0
    """Over the last so many steps every learning rate falls, by the same factor every step, to the part cooldown-to of
    itself; 0: none falls."""
    cooldown_to: float = 0.1
    """Part of every learning rate that is left after the cooldown's last step, more than 0, at most 1."""
    beta1: float = 0.9
    """Part of Adam's first moment, the mean gradient, that is kept from step to step."""
    beta2: float = 0.999
    """Part of Adam's second moment, the mean squared gradient, that is kept from step to step."""
    epsilon: float = 1e-15
    """Adam's epsilon, which is added to the root of the second moment before dividing by it."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value makes no sense."""
        rates = tuple(each.name for each in fields(self) if each.name.endswith(("_rate", "_rate_end")))
        rules: tuple[_Rule, ...] = (
            (rates, lambda value: 0 <= value < inf, "a finite number, at least 0"),
            (("means_rate_steps", "sh_rest_every"), lambda value: value >= 1, "at least 1"),
            (("cooldown",), lambda value: value >= 0, "at least 0"),
            (("cooldown_to",), lambda value: 0 < value <= 1, "more than 0, at most 1"),
            (("beta1", "beta2"), lambda value: 0 <= value < 1, "at least 0, less than 1"),
            (("epsilon",), lambda value: 0 < value < inf, "a finite number, more than 0"),
        )
        _check_kinds(self, "--optimiser.")
        _check(self, "--optimiser.", rules)
        if self.means_rate > 0 and self.means_rate_end == 0:  # in between it would be 0 as well, from the first step on
            raise InputError("--optimiser.means-rate-end 0.0: expected more than 0, the rate falls log-linearly to it")


@dataclass(frozen=True)
class DensityConfig:
    """Adaptive density control: where Gaussians are added and taken away (Kerbl et al. 2023, section 5)."""

    every: int = 100
    """Steps between densifications, in which Gaussians are cloned, split and pruned; 0 turns density control off."""
    start: int = 500
    """Last step without densification: Gaussians are cloned, split and pruned after later steps only."""
    stop: int = 15_000
    """Step from which on Gaussians are no longer cloned, split and pruned, nor opacities reset."""
    gradient_threshold: float = 2e-4
    """Mean gradient of a Gaussian's place on the screen, in units of half the image, from which on it is densified
    (cloned or split); less makes more Gaussians."""
    absolute_gradients: bool = False
    """Add up the gradients' absolute values pixel by pixel for that (AbsGS); gradient-threshold wants about 8e-4
    then."""
    dense_fraction: float = 0.01
    """Largest size of a Gaussian that is cloned, in parts of the scene's extent; larger ones are split."""
    split_factor: float = 1.6
    """Factor by which each half of a split Gaussian is smaller."""
    min_opacity: float = 0.005
    """Prune Gaussians whose opacity is less than this, 0 to 1."""
    max_world_fraction: float = 0.1
    """Prune Gaussians that are larger than this part of the scene's extent, after the first opacity reset."""
    max_screen_radius: float = 0.0
    """Prune Gaussians that covered a larger radius than this on the screen, in pixels, after the first opacity reset; 0
    prunes none."""
    opacity_reset_every: int = 3000
    """Steps between opacity resets, 0 for none; one more at density.start where the background is white."""
    opacity_reset_to: float = 0.01
    """Opacity is lowered to at most this at a reset."""
    max_gaussians: int = 10_000_000
    """Clones and splits stop at this number of Gaussians; where room is short, the largest gradients go first."""
    views_agree: int = 1
    """Densify only where the gradient was over the threshold in this many views since the last densification, and its
    mean too; 1 asks for the mean alone, as the paper. A view that came again counts again."""
    growth: Growth = "paper"
    """paper: densify what is over the threshold; budget: the number of Gaussians rises along a parabola to
    max-gaussians at density.stop, the largest gradients first, whatever the threshold (Taming 3DGS)."""
    min_contribution: float = 0.0
    """Prune Gaussians that add less than this to every training view of an epoch (a pass through all of them): alpha
    times transmittance, summed over the picture, in pixels. 0 prunes none."""
    prune_every: int = 0
    """Steps between prunings by opacity and contribution alone, which go on after density.stop; 0 for none."""
    prune_at: tuple[int, ...] = ()
    """Steps after which the Gaussians that contribute least are pruned, as many as prune-fraction says."""
    prune_fraction: float = 0.0
    """Share of the Gaussians, 0 to 1, that is pruned at each step of prune-at: those that contribute least over an
    epoch (Speedy-Splat). Not counted are those whose contribution is not known, as of all for two epochs after an
    opacity reset."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value makes no sense."""
        rules: tuple[_Rule, ...] = (
            (("every", "start", "stop", "opacity_reset_every"), lambda value: value >= 0, "at least 0"),
            (
                ("gradient_threshold", "max_world_fraction"),
                lambda value: 0 < value < inf,
                "a finite number, more than 0",
            ),
            (("dense_fraction",), lambda value: 0 < value <= 1, "more than 0, at most 1"),
            (("split_factor",), lambda value: 1 < value < inf, "a finite number, more than 1"),
            (("min_opacity", "opacity_reset_to"), lambda value: 0 < value < 1, "more than 0, less than 1"),
            (("max_screen_radius",), lambda value: 0 <= value < inf, "a finite number, at least 0"),
            (("max_gaussians", "views_agree"), lambda value: value >= 1, "at least 1"),
            (("min_contribution",), lambda value: 0 <= value < inf, "a finite number, at least 0"),
            (("prune_every",), lambda value: value >= 0, "at least 0"),
            (("prune_fraction",), lambda value: 0 <= value < 1, "at least 0, less than 1"),
        )
        _check_kinds(self, "--density.")
        _check(self, "--density.", rules)
        _check_steps("--density.prune-at", self.prune_at)
        if self.prune_fraction > 0 and not self.prune_at:
            raise InputError(
                f"--density.prune-fraction {self.prune_fraction}: never used, expected steps in --density.prune-at too"
            )
        if self.prune_at and self.prune_fraction == 0:
            steps = ",".join(map(str, self.prune_at))
            raise InputError(f"--density.prune-at {steps}: prunes nothing, expected --density.prune-fraction too")
        if self.growth == "budget" and self.max_gaussians == DensityConfig.max_gaussians:
            raise InputError(
                "--density.growth budget: expected --density.max-gaussians too, the number of Gaussians to grow to"
            )


@dataclass(frozen=True)
class TrainConfig:
    """One training run."""

    iterations: int = 30_000
    """Number of training steps. Learning rates and density control do not depend on it, but for --optimiser.cooldown,
    --schedule short and --preset fast."""
    seed: int = 0
    """Seed of everything random; the same seed on the same device gives the same model."""
    sh_degree: int = 3
    """Highest degree of the spherical harmonics (SH): how finely colours depend on the direction they are seen from, 0
    (not at all) to 3."""
    sh_degree_every: int = 1000
    """Steps after which the SH degree in use rises by one, from 0 to sh-degree."""
    dssim_weight: float = 0.2
    """Weight of D-SSIM (how unlike structures are) in the loss, 0 to 1; L1 (mean absolute difference) has the rest."""
    background: Background = "black"
    """Background behind the Gaussians and behind images with alpha; random: a new colour each step, and black in
    evaluations."""
    warmup: tuple[int, ...] = (250, 500)
    """Steps after which the training resolution doubles: with two of them training starts at a quarter of the size,
    with '' at the full size."""
    frequency_steps: int = 0
    """Steps within which the training resolution rises from an eighth of the size, as fast as the detail in the
    photographs asks (by their spectra), in place of --warmup; 0 goes by --warmup."""
    resolution: int = 0
    """Longest image side in pixels, in training and evaluation; 0 keeps the images' size up to 1600."""
    test_every: int = TEST_EVERY
    """Every n-th view by name is held out, the first too; 0 holds out none. A data set's own split goes first."""
    random_points: int = 100_000
    """Number of Gaussians to start from, at random places, where a scene has no points."""
    checkpoint_every: int = 1000
    """Steps between checkpoints; 0 writes one at the end only, or at an interruption."""
    eval_at: tuple[int, ...] = ()
    """Steps at which the held-out views are evaluated, besides the last."""
    stages_every: int = 100
    """Steps between those in which the time of each stage is measured for the report; such a step is slower, as the
    device is waited for after every stage. Only steps that metrics.jsonl has count; the last one is measured too. 0
    measures none."""
    report: bool = True
    """Write report.html at the end."""
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    rasterizer: RasterizerConfig = field(default_factory=RasterizerConfig)

    def check(self) -> None:
        """Raise InputError naming the first setting whose value makes no sense."""
        rules: tuple[_Rule, ...] = (
            (("sh_degree",), lambda value: 0 <= value <= 3, "0 to 3"),
            (("dssim_weight",), lambda value: 0 <= value <= 1, "0 to 1"),
            (("iterations", "sh_degree_every", "random_points"), lambda value: value >= 1, "at least 1"),
            (
                ("seed", "frequency_steps", "resolution", "test_every", "checkpoint_every", "stages_every"),
                lambda value: value >= 0,
                "at least 0",
            ),
        )
        _check_kinds(self, "--")
        _check(self, "--", rules)
        for name, steps in (("warmup", self.warmup), ("eval-at", self.eval_at)):
            _check_steps(f"--{name}", steps)
        if self.eval_at and self.eval_at[-1] > self.iterations:
            late = next(step for step in self.eval_at if step > self.iterations)
            raise InputError(
                f"--eval-at {late}: training ends before that, expected at most --iterations {self.iterations}"
            )
        self.optimiser.check()
        self.density.check()
        self.rasterizer.check()


def scheduled(schedule: Schedule, iterations: int) -> TrainConfig:
    """What `clsplat train --schedule` starts from.

    paper: the defaults, made for 30,000 steps, whatever `iterations` is. short: for runs of about 7000 steps, in which
    the paper's rates leave a model unfinished: colours, opacities and rotations learn faster, SH degrees come twice as
    fast, the means' rate has fallen at the end, density control ends at five sevenths, and the last seventh cools down
    (docs/decisions/0013-a-short-schedule.md).
    """
    if schedule == "paper":
        return TrainConfig(iterations=iterations)
    return TrainConfig(
        iterations=iterations,
        sh_degree_every=500,
        optimiser=OptimiserConfig(
            means_rate_steps=max(iterations, 1),
            sh_dc_rate=4e-3,
            sh_rest_rate=4e-4,
            opacities_rate=0.05,
            quaternions_rate=2e-3,
            cooldown=max(iterations // 7, 0),
            cooldown_to=0.2,
        ),
        density=DensityConfig(stop=max(5 * iterations // 7, 0)),
    )


def bundled(preset: Preset, schedule: Schedule | None, iterations: int) -> TrainConfig:
    """What `clsplat train --preset --schedule --iterations` start from.

    fast trains less: on pictures of a quarter of the size for a fourteenth of the steps and of half the size until two
    sevenths, with fewer Gaussians, those dropped that add less than a tenth of a pixel to every view, the rates of the
    short schedule with those of means, scales and rotations up to four times higher, and the higher SH bands in every
    second step (docs/decisions/0015-the-fast-preset.md).
    """
    config = scheduled(schedule or ("short" if preset == "fast" else "paper"), iterations)
    config = replace(config, rasterizer=PRESETS[preset])
    if preset != "fast":
        return config
    optimiser = config.optimiser
    return replace(
        config,
        warmup=tuple(sorted({max(iterations // 14, 1), max(2 * iterations // 7, 1)})),
        optimiser=replace(
            optimiser,
            means_rate=2 * optimiser.means_rate,
            scales_rate=4 * optimiser.scales_rate,
            quaternions_rate=2 * optimiser.quaternions_rate,
            sh_rest_every=2,
        ),
        density=replace(config.density, gradient_threshold=3e-4, min_contribution=0.1),
    )
