# SPDX-License-Identifier: Apache-2.0
"""Settings of training: learning rates and Adam, density control, loss, photographs, points and refinement.

Flags, help and `config.toml` come from these dataclasses. The defaults follow the 3DGS authors' code of 2024, with the
paper's resolution warm-up. A comment beside a setting has its names in that code and in gsplat.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from math import inf
from typing import Any, Literal

from clsplat.config.checks import Rule, check_kinds, check_rules, check_steps
from clsplat.config.cli_defaults import TEST_EVERY, TEST_MOST
from clsplat.config.depth import DepthSource, DepthUse, MapKind
from clsplat.config.masks import AlphaMeaning, MaskMeaning, MaskUse
from clsplat.config.orientation import FrameUse, Orient, parse_scale
from clsplat.config.points import DEFAULT_MAX_FILE_POINTS, PointsUse, StartPoints
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.errors import InputError

Background = Literal["black", "white", "random"]
Lenses = Literal["undistort", "native"]
Missing = Literal["few", "skip", "error"]
Perspective = Literal["auto", "plane", "rays"]
Growth = Literal["paper", "budget", "mcmc"]
AppearanceKind = Literal["none", "exposure", "ppisp", "grid"]
Photos = Literal["auto", "exact", "8bit"]
ViewOrderKind = Literal["random", "near"]

MANY_PHOTOGRAPHS = 300
"""Number of training photographs that counts as many. With this number or more, a photograph is decoded only when a
step first needs it, and --photos auto stores photographs with 8 bits per channel."""


@dataclass(frozen=True)
class OptimiserConfig:
    """Learning rates and Adam's constants, with a rate per parameter group."""

    means_rate: float = 1.6e-4  # position_lr_init, means_lr
    """Learning rate of the Gaussians' centres (means) at the first step, relative to the scene's length unit."""
    means_rate_end: float = 1.6e-6  # position_lr_final
    """Learning rate of the means after means-rate-steps, relative to the length unit. Until then the rate falls
    exponentially."""
    means_rate_steps: int = 30_000  # position_lr_max_steps
    """Steps over which the learning rate of the means falls."""
    sh_dc_rate: float = 2.5e-3  # feature_lr, sh0_lr
    """Learning rate of the colours: the constant band of the spherical harmonics."""
    sh_rest_rate: float = 2.5e-3 / 20  # feature_lr / 20, shN_lr
    """Learning rate of the colours' dependence on direction: the higher bands of the spherical harmonics."""
    opacities_rate: float = 0.025  # opacity_lr, opacities_lr
    """Learning rate of the opacities, as logits."""
    scales_rate: float = 5e-3  # scaling_lr, scales_lr
    """Learning rate of the scales, as logarithms."""
    quaternions_rate: float = 1e-3  # rotation_lr, quats_lr
    """Learning rate of the rotations, as quaternions."""
    sparse: bool = False
    """Do not update parameters whose gradient is zero, nor their Adam moments (approximate). The gradient is zero for
    Gaussians out of view, masked, or behind others."""
    late: bool = False
    """Do not update Gaussians that a step's view does not show. After a view shows them again, update them for the
    missed steps too (approximate: this view is rendered before the update). Not with batches."""
    sh_rest_every: int = 1
    """Steps between updates of the higher SH bands (approximate above 1)."""
    cooldown: int = 0
    """Number of final steps over which every learning rate falls exponentially, to cooldown-to times its value. 0: no
    cooldown."""
    cooldown_to: float = 0.1
    """Fraction of every learning rate that is left after the cooldown; more than 0, at most 1."""
    beta1: float = 0.9
    """Decay of Adam's first moment, the mean gradient: the fraction that is kept at each step."""
    beta2: float = 0.999
    """Decay of Adam's second moment, the mean squared gradient: the fraction that is kept at each step."""
    epsilon: float = 1e-15
    """Adam's epsilon, which is added to the root of the second moment before dividing by it."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value is invalid."""
        rates = tuple(setting.name for setting in fields(self) if setting.name.endswith(("_rate", "_rate_end")))
        rules: tuple[Rule, ...] = (
            (rates, lambda value: 0 <= value < inf, "a finite number, at least 0"),
            (("means_rate_steps", "sh_rest_every"), lambda value: value >= 1, "at least 1"),
            (("cooldown",), lambda value: value >= 0, "at least 0"),
            (("cooldown_to",), lambda value: 0 < value <= 1, "more than 0, at most 1"),
            (("beta1", "beta2"), lambda value: 0 <= value < 1, "at least 0, less than 1"),
            (("epsilon",), lambda value: 0 < value < inf, "a finite number, more than 0"),
        )
        check_kinds(self, "--optimiser.")
        check_rules(self, "--optimiser.", rules)
        if self.late and self.sparse:
            raise InputError("--optimiser.late: excludes --optimiser.sparse, which drops the missed steps")
        # the sum of a parameter's missed updates diverges if beta1^2 >= beta2
        if self.late and self.beta1**2 >= self.beta2:
            raise InputError(
                f"--optimiser.late: expected beta1^2 < beta2, but beta1 is {self.beta1} and beta2 {self.beta2}"
            )
        if self.means_rate > 0 and self.means_rate_end == 0:  # exponential decay cannot end at 0
            raise InputError("--optimiser.means-rate-end 0.0: expected more than 0; the rate falls to it log-linearly")


@dataclass(frozen=True)
class DensityConfig:
    """Adaptive density control: when Gaussians are added and removed (Kerbl et al. 2023, section 5)."""

    every: int = 100  # densification_interval, refine_every
    """Steps between densifications, which clone, split and prune Gaussians; 0 turns density control off."""
    start: int = 500  # densify_from_iter, refine_start_iter
    """Last step without densification: Gaussians are cloned, split and pruned only after later steps."""
    stop: int = 15_000  # densify_until_iter, refine_stop_iter
    """First step without further density control: Gaussians are no longer cloned, split and pruned, nor opacities
    reset."""
    gradient_threshold: float = 2e-4  # densify_grad_threshold, grow_grad2d
    """Mean screen-space gradient from which a Gaussian is densified (cloned or split), in units of half the image.
    Lower values make more Gaussians."""
    absolute_gradients: bool = False  # absgrad
    """Compare gradient-threshold with sums of absolute per-pixel gradients (AbsGS). gradient-threshold should then be
    about 8e-4."""
    dense_fraction: float = 0.01  # percent_dense, grow_scale3d
    """Largest scale of a Gaussian that is cloned, relative to the scene's length unit; larger ones are split."""
    split_factor: float = 1.6
    """Factor by which each half of a split Gaussian is smaller than the original."""
    min_opacity: float = 0.005  # prune_opa
    """Prune Gaussians whose opacity is less than this, 0 to 1."""
    max_world_fraction: float = 0.1  # prune_scale3d
    """Prune Gaussians larger than this fraction of the scene's length unit, after the first opacity reset."""
    max_screen_radius: float = 0.0  # max_screen_size, prune_scale2d
    """Prune Gaussians that covered a larger radius than this on the screen, in pixels, after the first opacity reset; 0
    prunes none."""
    opacity_reset_every: int = 3000  # opacity_reset_interval, reset_every
    """Steps between opacity resets, until density.stop; 0 for none. A white background adds one at density.start."""
    opacity_reset_to: float = 0.01
    """Maximum opacity after a reset."""
    max_gaussians: int = 10_000_000  # cap_max
    """Maximum number of Gaussians, at which cloning and splitting stop. Near the limit, Gaussians with the largest
    gradients are cloned and split first."""
    growth: Growth = "paper"
    """paper: densify Gaussians over the threshold. budget: the number of Gaussians rises along a parabola to
    max-gaussians at density.stop, largest gradients first, whatever the threshold (Taming 3DGS). mcmc: Gaussians under
    min-opacity move to those with the largest gradients, and noise moves nearly transparent ones (3DGS-MCMC). The
    number rises by the same factor each time, to max-gaussians at density.stop. mcmc splits Gaussians along the longest
    axis, also when it moves them, and has no clones and resets. Gaussians over max-screen-radius are also moved, from
    the start."""
    long_axis: bool = False
    """Split Gaussians, small or large, along their longest axis, into two halves on that axis (Improved-GS). No
    Gaussian is cloned then. Growth mcmc always splits like this."""
    spread: float = 1.0
    """With growth mcmc: random distance of a moved Gaussian from its target's mean, in standard deviations. 0 puts it
    at the mean, as published. Applies only if there are more Gaussians to move than Gaussians with a gradient."""
    noise_rate: float = 5e5  # noise_lr
    """With growth mcmc: noise added to the means in each step, in multiples of the means' learning rate. The value is
    for Gaussians of scale 1 in a scene of length unit 1. 0 adds none. The cooldown has no noise."""
    opacity_weight: float = 0.01  # opacity_reg
    """With growth mcmc: weight of the opacities in the loss. They are summed over the Gaussians in the step's view, and
    divided by the number of all Gaussians."""
    scale_weight: float = 0.01  # scale_reg
    """With growth mcmc: like opacity-weight, but for scales relative to the scene's length unit."""
    min_contribution: float = 0.0
    """Prune Gaussians whose contribution to each training view in an epoch (a pass through all) is less than this. A
    contribution is alpha times transmittance, summed over the picture, in pixels. 0 prunes none."""
    prune_every: int = 0
    """Steps between prunings by opacity and contribution alone, which continue after density.stop; 0 for none."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value is invalid."""
        rules: tuple[Rule, ...] = (
            (
                ("every", "start", "stop", "opacity_reset_every", "prune_every"),
                lambda value: value >= 0,
                "at least 0",
            ),
            (
                ("gradient_threshold", "max_world_fraction"),
                lambda value: 0 < value < inf,
                "a finite number, more than 0",
            ),
            (("dense_fraction",), lambda value: 0 < value <= 1, "more than 0, at most 1"),
            (("split_factor",), lambda value: 1 < value < inf, "a finite number, more than 1"),
            (("min_opacity", "opacity_reset_to"), lambda value: 0 < value < 1, "more than 0, less than 1"),
            (
                ("max_screen_radius", "min_contribution", "spread", "noise_rate", "opacity_weight", "scale_weight"),
                lambda value: 0 <= value < inf,
                "a finite number, at least 0",
            ),
            (("max_gaussians",), lambda value: value >= 1, "at least 1"),
        )
        check_kinds(self, "--density.")
        check_rules(self, "--density.", rules)
        if self.fills and self.max_gaussians == DensityConfig.max_gaussians:
            raise InputError(
                f"--density.growth {self.growth}: expected --density.max-gaussians too, the number of Gaussians to "
                "grow to"
            )
        if self.growth == "mcmc" and self.prune_every:
            raise InputError(
                "--density.growth mcmc: moves Gaussians and prunes none before the end, expected no "
                "--density.prune-every"
            )

    @property
    def fills(self) -> bool:
        """True if the strategy raises the number of Gaussians to max-gaussians, whatever their gradients."""
        return self.growth in ("budget", "mcmc")


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training."""

    iterations: int = 30_000  # max_steps
    """Number of training steps, each of one view. Learning rates and density control do not depend on it, except for
    --optimiser.cooldown, --schedule short and high-rates, and --preset fast."""
    batch: int = 1  # batch_size
    """Views whose gradients are summed before the model changes. Each view still counts as a step. Learning rates and
    Adam's constants are scaled for the batch (Zhao et al. 2024). If not given: one view for each device."""
    seed: int = 0
    """Seed of all random numbers. The same seed on the same device gives the same model."""
    sh_degree: int = 3
    """Highest degree of the spherical harmonics (SH): how finely colours depend on the viewing direction, 0 (not at
    all) to 3."""
    sh_degree_every: int = 1000  # sh_degree_interval
    """Steps after which the SH degree in use rises by one, from 0 to sh-degree."""
    dssim_weight: float = 0.2  # lambda_dssim, ssim_lambda
    """Weight w of D-SSIM (structural dissimilarity) in the loss, 0 to 1. L1 (mean absolute difference) has 1 - w."""
    background: Background = "black"  # white_background, random_background, random_bkgd
    """Background behind the Gaussians and behind images with alpha. random: a new colour each step, and black in
    evaluations."""
    thinning: float = 0.0
    """Dropout for few photographs (DropGaussian): fraction of the Gaussians to leave out at random, 0 to 0.9. It rises
    from 0 at the first step to this value at the last. The others are more opaque in the same step. 0.2 is as
    published; 0 leaves none out."""
    penalty: float = 0.0
    """Weight of two penalties in the loss: the mean opacity, and the mean scale relative to the scene's length unit.
    Only Gaussians in the step's view add to these means. 0.02 helps against fog if there are few photographs.
    --density.growth mcmc has weights of its own instead."""
    antialiased: bool = False
    """Train for pictures of any size (Mip-Splatting). A narrower low-pass filter preserves a Gaussian's light, and no
    Gaussian is smaller than the photographs can show. The model file records this, and renders do the same."""
    perspective: Perspective = "auto"
    """Projection of a Gaussian in pinhole pictures. plane: as an ellipse on the image plane (Kerbl et al.). rays: along
    the rays of the pixels, as for fisheyes and panoramas, which takes longer. auto: rays if the scene has fisheyes or
    panoramas, so that all photographs share a projection. The model file records this, and renders do the same."""
    masks: MaskMeaning = "none"
    """Meaning of the photographs' masks, which are white where a pixel is kept. ignore: the loss ignores black pixels,
    such as people. transparent: black pixels are empty, such as around an object on a turntable. none: masks are not
    used."""
    invert_masks: bool = False
    """Invert masks: black pixels are kept, and white ones are ignored or transparent."""
    alpha: AlphaMeaning = "blend"
    """Meaning of the photographs' alpha channels. blend: colours are blended over the background. ignore and
    transparent: as for masks."""
    alpha_weight: float = 0.1
    """Weight of the alpha loss, the mean absolute difference between the alphas of the render and of the photograph.
    Used if masks or alpha mean transparent. Training's background is then random, and --background applies only to
    evaluations."""
    warmup: tuple[int, ...] = (250, 500)
    """Training steps after which the resolution doubles. With two steps, training starts at a quarter of the size; with
    '', at the full size."""
    resolution: int = 0
    """Longest image side in pixels, in training and evaluation; 0 keeps the images' size up to 1600."""
    photos: Photos = "auto"
    """Precision of the photographs' pixels at the training resolution. exact: as resized. 8bit: rounded to levels of
    1/255, which takes a quarter of the memory. Photographs with values outside 0 to 1 (HDR) stay exact. auto: exact for
    fewer than 300 training photographs, else 8bit."""
    view_order: ViewOrderKind = "random"
    """Order of the photographs in each pass through all of them. near: clusters of photographs that show the same
    things, by their positions and viewing directions; four clusters take turns. Then a step shows more of the Gaussians
    that were in view a few steps before. This may cost some PSNR."""
    test_every: int = TEST_EVERY
    """Every n-th view by name is held out, including the first; 0 holds out none. A data set's own split takes
    precedence."""
    test_most: int = TEST_MOST
    """Maximum number of views that test-every holds out, spread evenly; 0 for no maximum."""
    missing: Missing = "few"
    """Handling of pictures that the scene lists but that are missing. few: up to a tenth of them are left out, with a
    warning, and more are an error. skip: any number is left out. error: none may be missing. The held-out views stay
    the same."""
    orient: Orient = "none"
    """up: turn the scene upright, with the ground at zero and the middle in the middle. Up is -y, by gravity or GPS in
    the photographs' metadata, a level plane of points, and the cameras. none: keep the frame of the scene's files;
    photos alone are turned by clsplat sfm. frame.json in the run has the transform."""
    scale: str = ""
    """Length that makes world units metres. A.JPG,B.JPG=METRES: the distance between the cameras of two photographs.
    X,Y,Z,X,Y,Z=METRES: between two points in the scene's frame. gps: the positions in the photographs' EXIF. With
    --orient up and gps, z points north. Depth maps are scaled too. If empty: the scale of the scene's files."""
    lenses: Lenses = "undistort"
    """Handling of fisheye photographs. undistort: convert to the pinhole pictures that they contain. native: train with
    the fisheye lens, which shows the whole photograph, also beyond 180 degrees. Panoramas (EQUIRECTANGULAR) are always
    trained natively."""
    random_points: int = 100_000  # init_num_pts
    """Number of Gaussians to start from, at random places, if a scene has no points."""
    points: str = ""
    """File of points to start from, in the scene's frame: PLY (also COLMAP's fused.ply), or LAS and LAZ with the extra
    las. Points without colours are coloured by the photographs that show them. A scene without points uses a cloud
    next to it, such as points3d.ply."""
    points_use: PointsUse = "replace"
    """replace: the file's points replace the scene's own. join: they are added."""
    points_limit: int = 0
    """Maximum number of points to keep: of the file --points, or without it of the scene's points. Points are merged by
    voxel into one point, with the mean of their positions and colours. Voxels are as small as the limit allows. 0 keeps
    200,000 points of a file, and all points of a scene."""
    sky: int = 0
    """Maximum number of sky points to start from, on a sphere around the scene, where photographs show nothing above
    the scene's points; 0 for none."""
    depth: DepthSource = "none"
    """Known depths to compare with the render. points: the points of a COLMAP model, in the photographs that show them.
    maps: depth maps in depths/ next to images/, or depth_file_path of transforms.json. none: no depths."""
    depth_weight: float = 0.01  # depth_lambda
    """Weight of the depth loss at the first step. The loss is the mean difference of inverse depths, in units of one
    over the scene's length unit. The weight falls to a hundredth at the last step."""
    depth_maps: MapKind = "metric"
    """Values in depth maps. metric: distances along the camera's axis, or from the camera for fisheyes and panoramas; 0
    where unknown. relative: numbers that are larger for nearer things, which are scaled to the scene's points."""
    depth_unit: float = 1e-3
    """World units per step of an integer depth map (PNG). The default is for millimetres in a scene in metres."""
    checkpoint_every: int = 1000
    """Steps between checkpoints; 0 writes only one, at the end or at an interruption."""
    eval_at: tuple[int, ...] = ()
    """Steps at which the held-out views are evaluated, in addition to the last."""
    stages_every: int = 100
    """Steps between measurements of the time of each stage for the report. Such a step is slower, because it waits for
    the device after every stage. Only steps that metrics.jsonl records are measured, and always the last. 0 measures
    none."""
    report: bool = True
    """Write report.html at the end."""
    appearance: AppearanceKind = "none"
    """exposure: learn a gain for each colour channel of each photograph, so that exposure and white balance stay out of
    the model, which has their mean. ppisp: also learn how channels mix, for cameras with different colour processing,
    and a vignette for each lens, for darker corners. grid: a bilateral grid of colour maps for each photograph. It also
    covers changes by place and brightness, such as in edited photographs. none: photographs are used unchanged."""
    appearance_rate: float = 2e-3
    """Learning rate of appearance, for base-2 logarithms of gains, or for coefficients of a grid. It is multiplied by
    the root of the number of photographs and, for gains in a training of fewer than 10,000 steps, by 10,000 / steps."""
    refine_poses: bool = False  # pose_opt
    """Refine the poses of all training views but two while the model is trained. refined/ in the run has the cameras as
    a COLMAP model. eval.json has the PSNR of held-out views after aligning them with the model. Not with batches."""
    pose_reach: float = 5.0  # in place of a learning rate such as pose_opt_lr
    """Approximate limit of a refined pose's rotation over a training, in degrees. The limit of its movement is this
    angle in radians, times the scene's length unit."""
    refine_lenses: bool = False
    """Refine focal lengths and principal points while the model is trained. Photographs with the same lens share them.
    refined/ in the run has the refined cameras. Only for photographs without distortion, and not with batches."""
    lens_reach: float = 2.0
    """Approximate limit, over a training, of the change of the focal length and the principal point, in percent of the
    focal length."""
    refine_gate: float = 1.0
    """Tolerated loss of the held-out views' mean PSNR, in decibels. If the PSNR is below its best by more than this in
    two measurements in a row, training goes back to the best cameras and stops refining. At most 8 views are
    measured, when refinement begins and at every tenth of the training. Their poses are as given, or moved by the mean
    motion of the refined poses, whichever fits better. A warning at the end reports if aligning the views raises the
    PSNR by more than this. 0 turns the measurements and the warning off. Without held-out views nothing is measured."""
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    rasterizer: RasterizerConfig = field(default_factory=RasterizerConfig)

    def check(self) -> None:
        """Raise InputError naming the first setting whose value is invalid."""
        rules: tuple[Rule, ...] = (
            (("sh_degree",), lambda value: 0 <= value <= 3, "0 to 3"),
            (("appearance_rate",), lambda value: 0 <= value < inf, "a finite number, at least 0"),
            (("dssim_weight",), lambda value: 0 <= value <= 1, "0 to 1"),
            (("thinning",), lambda value: 0 <= value <= 0.9, "0 to 0.9"),
            (
                ("alpha_weight", "depth_weight", "penalty", "refine_gate"),
                lambda value: 0 <= value < inf,
                "a finite number, at least 0",
            ),
            (("pose_reach",), lambda value: 0 < value <= 30, "over 0 and at most 30 degrees"),
            (("lens_reach",), lambda value: 0 < value <= 50, "over 0 and at most 50 percent"),
            (("depth_unit",), lambda value: 0 < value < inf, "a finite number, more than 0"),
            (("iterations", "batch", "sh_degree_every", "random_points"), lambda value: value >= 1, "at least 1"),
            (
                (
                    "seed",
                    "resolution",
                    "test_every",
                    "test_most",
                    "checkpoint_every",
                    "stages_every",
                    "sky",
                    "points_limit",
                ),
                lambda value: value >= 0,
                "at least 0",
            ),
        )
        check_kinds(self, "--")
        check_rules(self, "--", rules)
        for name, steps in (("warmup", self.warmup), ("eval-at", self.eval_at)):
            check_steps(f"--{name}", steps)
        parse_scale(self.scale)
        self._check_together()
        self.optimiser.check()
        self.density.check()
        self.rasterizer.check()

    def _check_together(self) -> None:
        """Raise InputError naming the first setting that contradicts another."""
        if self.eval_at and self.eval_at[-1] > self.iterations:
            late = next(step for step in self.eval_at if step > self.iterations)
            raise InputError(
                f"--eval-at {late}: training ends before that, expected at most --iterations {self.iterations}"
            )
        if self.invert_masks and self.masks == "none":
            raise InputError("--invert-masks: no masks are used, expected --masks ignore or --masks transparent too")
        if self.points_use != "replace" and not self.points:
            raise InputError(f"--points-use {self.points_use}: no points are given, expected --points FILE too")
        if self.appearance != "none" and "transparent" in (self.masks, self.alpha):
            raise InputError(
                f"--appearance {self.appearance}: excludes --masks transparent and --alpha transparent, expected ignore"
            )
        if self.penalty and self.density.growth == "mcmc":
            raise InputError(
                f"--penalty {self.penalty}: --density.growth mcmc has weights of its own, expected "
                "--density.opacity-weight and --density.scale-weight"
            )
        if self.refine_lenses and self.perspective == "rays":
            raise InputError("--refine-lenses: not supported with --perspective rays, expected --perspective plane")
        if self.refines and self.batch > 1:
            raise InputError(
                f"{self._refining}: not supported with --batch {self.batch} or several devices, expected --batch 1"
            )
        if self.optimiser.late and self.batch > 1:
            raise InputError(
                f"--optimiser.late: not supported with --batch {self.batch} or several devices, expected --batch 1"
            )
        if self.depth != "maps" and self.depth_maps != "metric":
            raise InputError(f"--depth-maps {self.depth_maps}: no depth maps are used, expected --depth maps too")

    def changed(self, name: str, value: Any) -> TrainConfig:
        """Return a copy in which the setting `name` has the value `value`.

        name: such as "seed", or, for a setting of a group, "density.stop".
        """
        group, dot, setting = name.partition(".")
        return replace(self, **{group: replace(getattr(self, group), **{setting: value}) if dot else value})

    @property
    def refines(self) -> bool:
        """True if poses or lenses are refined."""
        return self.refine_poses or self.refine_lenses

    @property
    def _refining(self) -> str:
        return "--refine-poses" if self.refine_poses else "--refine-lenses"

    @property
    def mask_use(self) -> MaskUse:
        """Meaning of the scene's masks and alpha channels."""
        return MaskUse(self.masks, self.alpha, self.invert_masks)

    @property
    def frame_use(self) -> FrameUse:
        """How the frame of the scene's files is changed."""
        return FrameUse("up" if self.orient == "up" else None, self.scale)

    def rounds_photos(self, photographs: int) -> bool:
        """True if --photos rounds pixels to 8 bits per channel. photographs: number of training photographs."""
        return self.photos == "8bit" or (self.photos == "auto" and photographs >= MANY_PHOTOGRAPHS)

    @property
    def depth_use(self) -> DepthUse:
        """Source of the known depths to compare with the render, and the units of depth maps."""
        return DepthUse(self.depth, self.depth_maps, self.depth_unit) if self.depth != "none" else DepthUse()

    @property
    def start_points(self) -> StartPoints:
        """Points to start from, in addition to or instead of the scene's own."""
        limit = self.points_limit or (DEFAULT_MAX_FILE_POINTS if self.points else 0)
        return StartPoints(self.points, self.points_use, limit, self.sky)

    @property
    def random_background(self) -> bool:
        """True if each step has a background of a random colour."""
        return self.background == "random" or "transparent" in (self.masks, self.alpha)

    @property
    def alpha_loss(self) -> float:
        """Weight of the alpha loss; 0 unless masks or alpha channels mean transparent."""
        return self.alpha_weight if "transparent" in (self.masks, self.alpha) else 0.0

    def on_devices(self, count: int, *, explicit: bool) -> TrainConfig:
        """Return the settings for `count` devices. A batch of 1 becomes one view per device, unless `explicit`.

        explicit: True if the batch was given on the command line.
        Raises InputError for a batch that the devices cannot share evenly, or if several devices would refine cameras.
        """
        if self.refines and count > 1:
            raise InputError(f"{self._refining}: not supported with {count} devices, expected one")
        if self.batch == 1 and not explicit:
            return replace(self, batch=count)
        if self.batch % count:
            raise InputError(f"--batch {self.batch}: expected a multiple of {count}, the number of devices")
        return self
