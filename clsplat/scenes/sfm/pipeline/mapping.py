# SPDX-License-Identifier: Apache-2.0
"""Recovery of camera poses and points from verified matches, with pycolmap's incremental or global mapper."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pycolmap

from clsplat.scenes.sfm.pipeline.database import weight_gps

MIN_MODEL_PHOTOS = 3
"""Minimum number of photographs in a model."""
MIN_SHOWN_POINTS = 15
"""Minimum number of points that a photograph of the global mapper shows. The incremental mapper places a photograph by
at least this many, with its lower thresholds."""
GLOBAL_ADJUSTMENT_GROWTH = 1.3
"""Factor by which a model grows, in photographs or points, before all its poses and points are adjusted again.
pycolmap's default is 1.1."""
GLOBAL_REFINEMENTS, LOCAL_REFINEMENTS = 1, 1
"""Numbers of rounds of an adjustment of the whole model, and of the neighbours of a new photograph. Each round drops
outliers. pycolmap's defaults are 5 and 2."""
MIN_FIRST_ANGLE_DEG = 10.0
"""Minimum median angle between the rays of the first two photographs to their common points.

pycolmap's default is 16 degrees. Pairs of similar photographs are closer: of 2,104 in bonsai_photos 31 are over 16
degrees and 141 over 10. Many pairs are tried before one is found.
"""
MIN_COST_DECREASE = 1e-6
"""Relative decrease of the sum of squared errors below which an adjustment ends. With pycolmap's default of 0, most
adjustments end at their maximum number of iterations."""

Models = dict[Path, pycolmap.Reconstruction]
"""Models by their folders. Photographs that share too few matches with the others are in a model of their own."""


def incremental_models(
    database: Path,
    photos: Path,
    output: Path,
    *,
    threads: int,
    seed: int,
    relaxed: bool,
    by_gps: bool,
    placed: Callable[[], None],
) -> Models:
    """Recover models by adding one photograph after another.

    photos: folder of the photographs. output: folder for the models, which is made.
    relaxed: accept smaller triangulation angles and fewer matches than by default.
    by_gps: hold the cameras near their GPS positions, except for positions far off. The model is in metres then.
    placed: function that is called after each photograph that is added to the first two.
    """
    options = _incremental_options(threads, seed, relaxed=relaxed)
    if by_gps:
        weight_gps(database)
        options.use_prior_position = options.use_robust_loss_on_prior_position = True
    output.mkdir()
    models: dict[int, pycolmap.Reconstruction] = pycolmap.incremental_mapping(
        database_path=database,
        image_path=photos,
        output_path=output,
        options=options,
        next_image_callback=placed,
    )
    return {output / str(index): model for index, model in models.items()}


def _incremental_options(threads: int, seed: int, *, relaxed: bool) -> pycolmap.IncrementalPipelineOptions:
    """Return options for pycolmap's incremental mapper. relaxed: as in `incremental_models`."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = threads
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.min_model_size = MIN_MODEL_PHOTOS
    options.ba_global_frames_ratio = options.ba_global_points_ratio = GLOBAL_ADJUSTMENT_GROWTH
    options.ba_global_max_refinements, options.ba_local_max_refinements = GLOBAL_REFINEMENTS, LOCAL_REFINEMENTS
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = MIN_COST_DECREASE
    options.mapper.init_min_tri_angle = MIN_FIRST_ANGLE_DEG
    options.extract_colors = False  # they are extracted when all points are there
    # Poses are adjusted with enough points to cover every photograph, then the other points with these poses.
    options.mapper.ba_global_ignore_redundant_points3D = True
    if relaxed:
        options.mapper.init_min_tri_angle = 4.0
        options.mapper.init_max_forward_motion = 1.0
        options.mapper.init_min_num_inliers = 50
        options.mapper.abs_pose_min_num_inliers = 15
        options.mapper.filter_min_tri_angle = 0.8
        options.triangulation.min_angle = 1.0
    return options


def add_two_view_points(
    database: Path, photos: Path, folder: Path, *, threads: int, seed: int, relaxed: bool
) -> pycolmap.Reconstruction:
    """Add the points that only two photographs show to the model in a folder. Returns and writes the model.

    The mappers leave out these points, as points with more observations give better poses. But a training starts from
    the points, and at the edge of a capture many are seen by two photographs only. Poses and lenses stay as they are.

    relaxed: True if the model comes from `incremental_models` with `relaxed`.
    """
    options = _incremental_options(threads, seed, relaxed=relaxed)
    options.triangulation.ignore_two_view_tracks = False
    return pycolmap.triangulate_points(
        reconstruction=pycolmap.Reconstruction(folder),
        database_path=database,
        image_path=photos,
        output_path=folder,
        clear_points=False,
        options=options,
    )


def global_models(database: Path, photos: Path, output: Path, *, threads: int, seed: int) -> Models:
    """Recover models by averaging the rotations of all pairs, then solving for all positions and points at once.

    The focal lengths of photographs without EXIF are first estimated from the pairs, since pairs need them here.
    """
    output.mkdir()
    calibration = pycolmap.ViewGraphCalibrationOptions()
    calibration.random_seed = seed
    pycolmap.calibrate_view_graph(database_path=database, options=calibration)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = threads
    options.random_seed = options.mapper.random_seed = seed
    options.mapper.rotation_averaging.random_seed = options.mapper.global_positioning.random_seed = seed
    options.mapper.retriangulation.random_seed = seed
    options.min_model_size = MIN_MODEL_PHOTOS
    models: dict[int, pycolmap.Reconstruction] = pycolmap.global_mapping(
        database_path=database, image_path=photos, output_path=output, options=options
    )
    found = {output / str(index): model for index, model in models.items()}
    for folder, model in found.items():
        remove_implausible(model)
        model.write(folder)
    return {folder: model for folder, model in found.items() if model.num_reg_images() >= MIN_MODEL_PHOTOS}


def remove_implausible(model: pycolmap.Reconstruction) -> None:
    """Remove the photographs that show fewer than MIN_SHOWN_POINTS points, or whose camera no lens has, from a model.

    The global mapper keeps photographs that lost all points, with a focal length that may be negative then. The limits
    of a camera are those of COLMAP's incremental mapper.
    """
    limits = pycolmap.IncrementalPipelineOptions()
    bounds = limits.min_focal_length_ratio, limits.max_focal_length_ratio, limits.max_extra_param
    while True:
        images = [model.images[image] for image in model.reg_image_ids()]
        frames = {
            image.frame_id
            for image in images
            if image.num_points3D < MIN_SHOWN_POINTS or model.cameras[image.camera_id].has_bogus_params(*bounds)
        }
        if not frames:
            break
        for frame in frames:  # other photographs lose the points that only they still show
            model.deregister_frame(frame)
    model.tear_down()  # cameras without photographs


def fragments(models: Models) -> tuple[Path, list[list[str]]]:
    """Return the folder of the model with the most photographs, and the photographs that only other models have.

    The photographs of each other model are listed by name, the longest list first. Models that add none are left out.
    """
    best = max(models, key=lambda path: models[path].num_reg_images())  # models are not sorted by size
    used, others = set(placed_names(models[best])), []
    for path in sorted(models, key=lambda path: -models[path].num_reg_images()):
        more = sorted(set(placed_names(models[path])) - used)
        used.update(more)
        if more:
            others.append(more)
    return best, sorted(others, key=len, reverse=True)


def placed_names(model: pycolmap.Reconstruction) -> list[str]:
    """Return the names of the photographs that have a pose, sorted."""
    return sorted(model.images[image].name for image in model.reg_image_ids())
