# SPDX-License-Identifier: Apache-2.0
"""Settings of training, each default once: these dataclasses are the command line, the `config.toml` and the help.

The training defaults are those of the paper's authors' 2024 code, with the paper's resolution warm-up.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from math import inf
from typing import Literal

from clsplat.config.checks import Rule, check_kinds, check_rules, check_steps
from clsplat.config.depth import DepthSource, DepthUse, MapKind
from clsplat.config.masks import AlphaMeaning, MaskMeaning, MaskUse
from clsplat.config.points import POINTS_OF_FILE, PointsUse, StartPoints
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.config.verbs import TEST_EVERY
from clsplat.errors import InputError

Background = Literal["black", "white", "random"]
Lenses = Literal["undistort", "native"]
Missing = Literal["few", "skip", "error"]
Perspective = Literal["auto", "plane", "rays"]
Growth = Literal["paper", "budget", "mcmc"]
AppearanceKind = Literal["none", "exposure", "ppisp", "grid"]


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
    """Steps from one update of the higher SH bands to the next (approximate above 1)."""
    cooldown: int = 0
    """Number of last steps over which every learning rate falls, by the same factor every step, to the part cooldown-to
    of itself; 0: none falls."""
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
    max-gaussians at density.stop, the largest gradients first, whatever the threshold (Taming 3DGS); mcmc: Gaussians
    under min-opacity move to where gradients are largest, and noise moves what is nearly transparent (3DGS-MCMC); the
    number rises by the same part each time to max-gaussians at density.stop. Both are by splits along the longest
    axis, there are no clones and resets; max-screen-radius moves Gaussians, from the start."""
    long_axis: bool = False
    """Split what is densified along its longest axis, small or large, into two that lie on it (Improved-GS); there are
    no clones then. Growth mcmc always does."""
    edge_views: int = 0
    """With growth budget: training views that are looked at before each densification. What is over gradient-threshold
    is then drawn at random, each as likely as what it adds to the photographs' edges there (Improved-GS); 0: the
    largest gradients go first, whatever the threshold."""
    spread: float = 1.0
    """With growth mcmc, where more Gaussians have to move than there are with a gradient: distance of what moves from
    the mean of the Gaussian that it comes to, in standard deviations, drawn at random; 0 puts it there, as
    published."""
    noise_rate: float = 5e5
    """With growth mcmc: noise added to the means each step, in learning rates of the means, for Gaussians of size 1 in
    a scene of extent 1; 0 adds none. None is added in the cooldown."""
    opacity_weight: float = 0.01
    """With growth mcmc: weight of the mean opacity in the loss, by the Gaussians that the step's view shows."""
    scale_weight: float = 0.01
    """With growth mcmc: weight of the mean size in the loss, in parts of the scene's extent, by the Gaussians that the
    step's view shows."""
    min_contribution: float = 0.0
    """Prune Gaussians that add less than this to every training view of an epoch (a pass through all of them): alpha
    times transmittance, summed over the picture, in pixels. 0 prunes none."""
    prune_every: int = 0
    """Steps between prunings by opacity and contribution alone, which go on after density.stop; 0 for none."""
    prune_at: tuple[int, ...] = ()
    """Steps after which the Gaussians that contribute least are pruned, as many as prune-fraction says."""
    prune_fraction: float = 0.0
    """Share of the Gaussians, 0 to 1, that is pruned at each step of prune-at: those that contribute least over an
    epoch (Speedy-Splat). Gaussians whose contribution is not known are not counted; after an opacity reset that is all
    of them, for two epochs."""

    def check(self) -> None:
        """Raise InputError naming the first setting whose value makes no sense."""
        rules: tuple[Rule, ...] = (
            (
                ("every", "start", "stop", "opacity_reset_every", "prune_every", "edge_views"),
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
            (("max_gaussians", "views_agree"), lambda value: value >= 1, "at least 1"),
            (("prune_fraction",), lambda value: 0 <= value < 1, "at least 0, less than 1"),
        )
        check_kinds(self, "--density.")
        check_rules(self, "--density.", rules)
        check_steps("--density.prune-at", self.prune_at)
        if self.prune_fraction > 0 and not self.prune_at:
            raise InputError(
                f"--density.prune-fraction {self.prune_fraction}: never used, expected steps in --density.prune-at too"
            )
        if self.prune_at and self.prune_fraction == 0:
            steps = ",".join(map(str, self.prune_at))
            raise InputError(f"--density.prune-at {steps}: prunes nothing, expected --density.prune-fraction too")
        if self.growth != "paper" and self.max_gaussians == DensityConfig.max_gaussians:
            raise InputError(
                f"--density.growth {self.growth}: expected --density.max-gaussians too, the number of Gaussians to "
                "grow to"
            )
        if self.edge_views and self.growth != "budget":
            raise InputError(
                f"--density.edge-views {self.edge_views}: chooses what a budget is spent on, expected --density.growth "
                "budget too"
            )
        if self.growth == "mcmc" and (self.prune_at or self.prune_every):
            found = "prune-at" if self.prune_at else "prune-every"
            raise InputError(
                f"--density.growth mcmc: moves Gaussians and prunes none before the end, expected no --density.{found}"
            )


@dataclass(frozen=True)
class TrainConfig:
    """One training run."""

    iterations: int = 30_000
    """Number of training steps, each of which is one view. Learning rates and density control do not depend on it, but
    for --optimiser.cooldown, --schedule short and high-rates, and --preset fast."""
    batch: int = 1
    """Views whose gradients are added up before the model changes. Each still counts as a step; with more of them
    learning rates and Adam's constants are scaled for it (Zhao et al. 2024). With several devices, if not given: one
    for each."""
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
    thinning: float = 0.0
    """For few photographs (DropGaussian): share of the Gaussians, drawn at random, that is left out of the last step, 0
    to 0.9; it rises from 0 at the first. The others are more opaque in that step. 0.2 is as published; 0 leaves none
    out."""
    penalty: float = 0.0
    """Weight in the loss of the mean opacity and of the mean size, in parts of the scene's extent, by the Gaussians
    that the step's view shows; 0.02 is of use against fog where there are few photographs. With --density.growth mcmc
    its own weights say that."""
    antialiased: bool = False
    """Train for pictures of any size (Mip-Splatting): a narrower low-pass that leaves a Gaussian its light, and no
    Gaussian smaller than the photographs show. The model is drawn so too, and its file says it."""
    perspective: Perspective = "auto"
    """How pinholes' pictures show a Gaussian. plane: as an ellipse on the image's plane (Kerbl et al.); rays: along the
    rays of the pixels, as fisheyes and panoramas do, which takes longer; auto: rays where the scene has photographs of
    these, so that all show the same. The model is drawn so too, and its file says it."""
    masks: MaskMeaning = "none"
    """Meaning of the masks beside the photographs, white where a pixel counts. ignore: what is black is not looked at,
    such as people; transparent: there is nothing there, such as around a thing on a turntable; none: no masks are
    used."""
    invert_masks: bool = False
    """Take the masks' black parts for those that count, and their white ones for those that do not."""
    alpha: AlphaMeaning = "blend"
    """Meaning of the photographs' alpha channels. blend: their colours are laid over the background; ignore and
    transparent: as of masks."""
    alpha_weight: float = 0.1
    """Weight of the alpha loss, the mean absolute difference between the render's alpha and the photograph's, where
    masks or alpha mean transparent. Training's background is random then, and --background that of evaluations."""
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
    missing: Missing = "few"
    """Pictures that the scene lists and that are not there. few: up to a tenth of them are left out, with a warning,
    and more are an error; skip: any number is left out; error: none may be missing. What is held out stays the same."""
    lenses: Lenses = "undistort"
    """Photographs of fisheyes: undistort, to the pinhole pictures that they hold; native: trained through their own
    lens, which sees all of them, also beyond 180 degrees. Panoramas (EQUIRECTANGULAR) always are."""
    random_points: int = 100_000
    """Number of Gaussians to start from, at random places, where a scene has no points."""
    points: str = ""
    """File of points to start from, in the scene's frame: PLY (COLMAP's fused.ply too), or with the extra las LAS and
    LAZ. Points without colours take those of the photographs that show them. Of a scene without points a cloud beside
    it is taken, such as points3d.ply."""
    points_use: PointsUse = "replace"
    """replace: the file's points stand in for the scene's own; join: they come in addition."""
    points_limit: int = 0
    """Most points to keep, of the file or else of the scene's own: one for each voxel that has some, the mean of their
    places and colours, with voxels as small as that leaves. 0 keeps 200,000 of a file, and all of the scene's own."""
    sky: int = 0
    """Points of a sky to start from, at most, on a sphere around the scene, where photographs show nothing above the
    scene's points; 0 for none."""
    depth: DepthSource = "none"
    """Known depths to compare the render's with. points: of the points of a COLMAP model, in the photographs that show
    them; maps: depth maps in depths/ beside images/, or depth_file_path of transforms.json; none: none are used."""
    depth_weight: float = 0.01
    """Weight of the depth loss at the first step, the mean difference of one over the depth, which counts in parts of
    one over the scene's extent; it falls to a hundredth at the last step."""
    depth_maps: MapKind = "metric"
    """metric: depth maps hold distances along the camera's axis, of fisheyes and panoramas from the camera, 0 where
    nothing is known; relative: numbers that grow with nearness, brought to scale by the scene's points."""
    depth_unit: float = 1e-3
    """World units of one step of a depth map of whole numbers (PNG); the default is of millimetres in a scene in
    metres."""
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
    appearance: AppearanceKind = "none"
    """exposure: learn a gain for each colour channel of each photograph, whose exposure and white balance then do not
    go into the model; it has their mean. ppisp: also how its channels mix, where cameras make colours in other ways,
    and a vignette for each lens, where corners are darker. grid: a bilateral grid of colour maps for each photograph,
    which also takes what changes by place and brightness, as where photographs were edited. none: photographs are taken
    as they are."""
    appearance_rate: float = 2e-3
    """Learning rate of appearance, as logarithms to base 2 of the gains, or as coefficients of a grid; times the
    root of the photographs' number, and for gains in trainings of fewer than 10,000 steps by as much more as they are
    shorter."""
    refine_poses: bool = False
    """Refine the poses of the training views with the model; two are held. The run's refined/ gets the cameras, a
    COLMAP model, and eval.json the PSNR of held-out views that were aligned with the model. Not with batches."""
    pose_reach: float = 5.0
    """Degrees by which a refined pose can turn in a training, about; it can move by as many 57ths of the scene's
    extent."""
    refine_lenses: bool = False
    """Refine focal lengths and principal points with the model, those of photographs that share a lens together. The
    run's refined/ gets them. For photographs without distortion; not with batches."""
    lens_reach: float = 2.0
    """Hundredths of the focal length by which it, or the principal point, can change in a training, about."""
    refine_gate: float = 1.0
    """Decibels by which the mean PSNR of held-out views can be under its best in two measurements in a row; then
    refined cameras return to those of the best and stay. At most 8 views are measured, where refinement begins and
    every tenth of the training, with poses as given or moved as the refined ones are on average, whichever fits. A
    warning tells at the end if views that fit the model best are ahead of those as given by more. 0: neither; nor is
    there a gate where no view is held out."""
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    rasterizer: RasterizerConfig = field(default_factory=RasterizerConfig)

    def check(self) -> None:
        """Raise InputError naming the first setting whose value makes no sense."""
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
            (("lens_reach",), lambda value: 0 < value <= 50, "over 0 and at most 50 hundredths"),
            (("depth_unit",), lambda value: 0 < value < inf, "a finite number, more than 0"),
            (("iterations", "batch", "sh_degree_every", "random_points"), lambda value: value >= 1, "at least 1"),
            (
                (
                    "seed",
                    "frequency_steps",
                    "resolution",
                    "test_every",
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
                f"--appearance {self.appearance}: not with --masks transparent or --alpha transparent, expected ignore"
            )
        if self.penalty and self.density.growth == "mcmc":
            raise InputError(
                f"--penalty {self.penalty}: --density.growth mcmc has weights of its own, expected "
                "--density.opacity-weight and --density.scale-weight"
            )
        if self.refine_lenses and self.perspective == "rays":
            raise InputError("--refine-lenses: rays have no gradient by the lens, expected --perspective plane with it")
        if self.refines and self.batch > 1:
            raise InputError(
                f"{self._refining}: not with --batch {self.batch}, nor with several devices; expected one view a step"
            )
        if self.depth != "maps" and self.depth_maps != "metric":
            raise InputError(f"--depth-maps {self.depth_maps}: no depth maps are used, expected --depth maps too")
        self.optimiser.check()
        self.density.check()
        self.rasterizer.check()

    @property
    def refines(self) -> bool:
        """True if cameras are refined."""
        return self.refine_poses or self.refine_lenses

    @property
    def _refining(self) -> str:
        return "--refine-poses" if self.refine_poses else "--refine-lenses"

    @property
    def mask_use(self) -> MaskUse:
        """The use of the scene's masks."""
        return MaskUse(self.masks, self.alpha, self.invert_masks)

    @property
    def depth_use(self) -> DepthUse:
        """The known depths that are compared."""
        return DepthUse(self.depth, self.depth_maps, self.depth_unit) if self.depth != "none" else DepthUse()

    @property
    def start_points(self) -> StartPoints:
        """The points to start from beside or in place of the scene's own."""
        limit = self.points_limit or (POINTS_OF_FILE if self.points else 0)
        return StartPoints(self.points, self.points_use, limit, self.sky)

    @property
    def random_background(self) -> bool:
        """True if each step has a background of its own."""
        return self.background == "random" or "transparent" in (self.masks, self.alpha)

    @property
    def alpha_loss(self) -> float:
        """Weight of the alpha loss, 0 where there is none."""
        return self.alpha_weight if "transparent" in (self.masks, self.alpha) else 0.0

    def on_devices(self, count: int, *, explicit: bool) -> TrainConfig:
        """The settings for `count` devices: a batch of a view for each, unless it is told. Raises InputError for a
        batch that they cannot share evenly."""
        if self.refines and count > 1:
            raise InputError(f"{self._refining}: not with {count} devices, expected one")
        if self.batch == 1 and not explicit:
            return replace(self, batch=count)
        if self.batch % count:
            raise InputError(f"--batch {self.batch}: expected a multiple of {count}, the number of devices")
        return self
