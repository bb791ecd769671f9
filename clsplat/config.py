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
    """What the rasterizer skips. The error of each switch, and the time it buys, are in docs/performance.md.

    `extent` "constant", `tile_test`, `depth_sort`, `key_bits`, `last_contributor`, `record_cells` and the `_skip`,
    `_stop` and `_cull` switches change no bit of a frame; they are there to be measured. The others are approximate
    where they differ from the default. `sh_tolerance` and `sh_storage` are of frames of a model that is held on the
    device (`Renderer`), not of training.
    """

    extent: Literal["opacity", "constant", "3sigma"] = "opacity"
    """How far a Gaussian reaches: to where its alpha is alpha-min; as far as an opaque one would, whatever its
    opacity; or three standard deviations, which cuts what is visible of opaque ones (approximate)."""
    tile_test: Literal["ellipse", "box", "square"] = "ellipse"
    """A Gaussian is listed in the tiles that its ellipse reaches, or in all of its bounding box's where those are at
    most 16; in those of its bounding box; or in those that the square of its longest half axis reaches, as in the code
    of Kerbl et al."""
    depth_sort: Literal["visible", "pairs"] = "visible"
    """The visible Gaussians are sorted by depth, and their pairs with tiles, stably, by tile; or all pairs are sorted
    by tile and depth, as in the code of Kerbl et al."""
    key_bits: Literal["needed", "all"] = "needed"
    """Sort by the bits in which the depths of the frame and its tiles differ, or by 32 of each."""
    row_skip: bool = True
    """Visit only the rows of a tile that the bounding box reaches."""
    column_skip: bool = True
    """Visit only the vectors of a row that the bounding box reaches."""
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
    """Leave out the SH bands above this degree (approximate)."""
    sh_tolerance: float = 0.0
    """Leave out a Gaussian's highest SH bands as long as that changes no channel of its colour by more than this, from
    any direction: 0 leaves out those that are zero (approximate above 0). Bands that none needs are always left out,
    those that some need only where that is half of all coefficients: from there on it pays."""
    sh_storage: Literal["float", "half"] = "float"
    """Keep the SH bands above 0 in 32 or in 16 bits (half is approximate, of half the memory)."""
    alpha_min: float = 1 / 255
    """Skip a Gaussian at a pixel where its alpha is less (approximate above 1/255, less than one 8-bit step)."""
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
    """Rate of the means at the start, times the scene's extent."""
    means_rate_end: float = 1.6e-6
    """Rate of the means at `means_rate_steps`, times the extent; log-linear in between."""
    means_rate_steps: int = 30_000
    """Steps over which the means' rate decays."""
    sh_dc_rate: float = 2.5e-3
    """Rate of the SH constant term."""
    sh_rest_rate: float = 2.5e-3 / 20
    """Rate of the higher SH bands."""
    opacities_rate: float = 0.025
    """Rate of the opacity logits."""
    scales_rate: float = 5e-3
    """Rate of the log scales."""
    quaternions_rate: float = 1e-3
    """Rate of the raw quaternions."""
    sparse: bool = False
    """Leave Gaussians that a step's view does not show as they are, their moments too (approximate)."""
    sh_rest_every: int = 1
    """Steps from one update of the higher SH bands to the next (approximate above 1)."""
    cooldown: int = 0
    """Over the last so many steps every rate falls, exponentially, to `cooldown_to` of itself; 0 for none."""
    cooldown_to: float = 0.1
    """What is left of every rate after the cooldown's last step."""
    beta1: float = 0.9
    """Decay of Adam's first moment."""
    beta2: float = 0.999
    """Decay of Adam's second moment."""
    epsilon: float = 1e-15
    """Adam's epsilon."""

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
    """Adaptive density control (Kerbl et al. 2023, section 5)."""

    every: int = 100
    """Steps between densifications; 0 turns density control off."""
    start: int = 500
    """Gaussians are cloned, split and pruned after steps later than this one."""
    stop: int = 15_000
    """Gaussians are cloned, split, pruned and reset after steps before this one."""
    gradient_threshold: float = 2e-4
    """Mean norm of the screen-space position gradient (in NDC units) from which a Gaussian is densified."""
    absolute_gradients: bool = False
    """Use sums of absolute per-pixel gradients (AbsGS) instead; the threshold wants about 8e-4 then."""
    dense_fraction: float = 0.01
    """Gaussians up to this fraction of the scene's extent are cloned, larger ones split."""
    split_factor: float = 1.6
    """A split divides the scales by this."""
    min_opacity: float = 0.005
    """Gaussians less opaque are pruned."""
    max_world_fraction: float = 0.1
    """Gaussians larger than this fraction of the extent are pruned, after the first opacity reset."""
    max_screen_radius: float = 0.0
    """Gaussians that covered a larger radius in pixels are pruned, after the first opacity reset; 0 prunes none."""
    opacity_reset_every: int = 3000
    """Steps between opacity resets, 0 for none; one more at `start` where the background is white."""
    opacity_reset_to: float = 0.01
    """Opacity is lowered to at most this at a reset."""
    max_gaussians: int = 10_000_000
    """Clones and splits stop at this number of Gaussians; where room is short, the largest gradients go first."""
    views_agree: int = 1
    """Densify only where the gradient was over the threshold in this many views since the last densification, beside
    its mean; 1 asks for the mean alone, as the paper. A view that came again counts again."""
    growth: Growth = "paper"
    """paper: densify what is over the threshold; budget: the number of Gaussians rises along a parabola to
    max-gaussians at `stop`, the largest gradients first, whatever the threshold (Taming 3DGS)."""
    min_contribution: float = 0.0
    """Gaussians whose blending weights came to less than so many pixels in every view of an epoch are pruned; 0 prunes
    none."""
    prune_every: int = 0
    """Steps between prunings by opacity and contribution alone, which go on after `stop`; 0 for none."""
    prune_at: tuple[int, ...] = ()
    """Steps after which the least contributing are pruned, by prune-fraction."""
    prune_fraction: float = 0.0
    """Share of the Gaussians, those with the smallest sums of blending weights over an epoch, that goes at each of
    prune-at (Speedy-Splat): of those whose sums are known, which none are for two epochs after an opacity reset."""

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
    """Number of steps; learning rates and density control do not depend on it, but for --optimiser.cooldown."""
    seed: int = 0
    """Seed of everything random; the same seed on the same device gives the same model."""
    sh_degree: int = 3
    """Highest spherical-harmonics degree, 0 to 3."""
    sh_degree_every: int = 1000
    """Steps between increases of the SH degree."""
    dssim_weight: float = 0.2
    """Weight of D-SSIM in the loss; L1 has the rest."""
    background: Background = "black"
    """Behind the Gaussians, and behind images with alpha; random is a new colour each step, evaluated on black."""
    warmup: tuple[int, ...] = (250, 500)
    """Steps after which the training resolution doubles; two of them start at a quarter, '' at the full size."""
    frequency_steps: int = 0
    """Steps within which the training resolution rises from an eighth of the size as the photographs' spectra ask, in
    place of --warmup; 0 goes by --warmup."""
    resolution: int = 0
    """Longest image side in pixels, in training and evaluation; 0 keeps the images' size up to 1600."""
    test_every: int = TEST_EVERY
    """Every n-th view by name is held out, the first too; 0 holds out none. A data set's own split goes first."""
    random_points: int = 100_000
    """Initial Gaussians where a scene has no points."""
    checkpoint_every: int = 1000
    """Steps between checkpoints; 0 writes only the last and the one of Ctrl-C."""
    eval_at: tuple[int, ...] = ()
    """Steps at which the held-out views are evaluated, beside the end."""
    stages_every: int = 100
    """Steps between those in which the time of each stage is measured, for the report, waiting for the device at every
    seam; in steps that metrics.jsonl has, the last one too. 0 measures none."""
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
