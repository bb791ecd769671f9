# SPDX-License-Identifier: Apache-2.0
"""Memory of a training: plans of device memory, the limit of main memory (--max-host-mem), scratch files and cache.

If memory runs out, `TrainingSession.rescue` in `training/loop.py` writes a checkpoint, and the training ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from clsplat.camera import Camera
from clsplat.chunks.bounds import measured_sides
from clsplat.chunks.bounds_table import BoundsTable
from clsplat.chunks.culling import PictureBorders, visible
from clsplat.chunks.division import chunks_of, listed_chunks
from clsplat.chunks.order import ORDERED_ROWS
from clsplat.config.checks import parse_bytes
from clsplat.config.masks import NO_MASKS
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.errors import CapacityError, InputError, amount, warn
from clsplat.gaussians import Gaussians, floats_of
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.rendering.memory_needs import MODELS, StepMemory, plan_step, plan_view
from clsplat.rendering.memory_plan import Plan
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.runs.run import Run
from clsplat.runs.scratch import ScratchFiles, owner_of
from clsplat.scenes.scene import Scene
from clsplat.stages.density import gaussian_bytes
from clsplat.training.batches.batch import OWNER_ARRAYS_PER_PARAMETER, REPLICA_ARRAYS_PER_PARAMETER, Batch
from clsplat.training.density import StatisticsNeeds
from clsplat.training.step.component import Component
from clsplat.training.step.gradient_step import slot_fields
from clsplat.training.step.visible_chunks import (
    MOST_MISSED_STEPS,
    STEPS_PER_MEASUREMENT,
    settings_of_whole_steps,
    streams_by_chunk,
)
from clsplat.training.supervision.decoded_store import DecodedStore, remove_decoded
from clsplat.training.supervision.decoding import Decoder
from clsplat.training.supervision.host_photographs import HostPhotographs
from clsplat.training.supervision.image_cache import ImageCache
from clsplat.training.supervision.resolution import by_doubling

NO_CACHE = "none"
"""Value of --cache that switches off the cache of decoded photographs."""
POOL_QUARTERS = 3
"""Number of quarters of the main memory beyond the photographs' minimum that a pool of chunks gets. The other quarter
goes to more photographs."""

MOST_VIEWS_LOOKED_AT = 200
"""Maximum number of views whose chunks in view are counted before the first step. With 20 million Gaussians a view
takes about 7 ms. If a later view shows more chunks than any of these, memory is planned again before its step."""


def model_bytes(config: TrainConfig) -> int:
    """Return the bytes per Gaussian of parameters, moments and statistics; with --batch, also of a view's gradients and
    of the sums of gradients."""
    arrays = MODELS if config.batch == 1 else OWNER_ARRAYS_PER_PARAMETER
    return arrays * 4 * floats_of((config.sh_degree + 1) ** 2) + gaussian_bytes(contributions=False)


@dataclass(frozen=True)
class HostMemory:
    """Limit of a training's main memory, and the folders for data beyond it.

    limit: maximum number of bytes for photographs and Gaussians; None for no limit.
    cache: folder of the cache of decoded photographs; None for no cache.
    keeps_cache: True if the user named the cache's folder, so that it stays after the training.
    scratch: folder for scratch files of Gaussians; None if there is no folder.
    owner: beginning of the names of this training's scratch files.
    run: run whose checkpoints name scratch files; None if there is no run.
    """

    limit: int | None = None
    cache: Path | None = None
    keeps_cache: bool = False
    scratch: Path | None = None
    owner: str = ""
    run: Run | None = None

    @classmethod
    def chosen(
        cls,
        max_host_mem: str | int | None,
        cache: str | Path | None,
        run: Run | None,
        scratch: str | Path | None = None,
    ) -> HostMemory:
        """Return the limit of main memory and the folders that these arguments of `clsplat.train` ask for.

        Also sets `run.scratch_path`. Raises InputError.

        max_host_mem: the limit, in bytes or as a text such as "8GiB"; None for no limit.
        cache: a folder, or "none" for no cache. None stands for RUN/cache if there is a limit, otherwise for no cache.
        scratch: a folder; None stands for RUN/scratch.
        """
        limit = parse_bytes(max_host_mem, "--max-host-mem")
        memory = cls._with_cache(limit, cache, run)
        if scratch is not None and (not str(scratch) or Path(scratch).is_file()):
            raise InputError(f"--scratch {scratch}: expected a folder")
        place = Path(scratch) if scratch is not None else (run.scratch_path if run is not None else None)
        if run is not None and place is not None:
            run.scratch_path = place
        return replace(memory, scratch=place, owner=owner_of(run), run=run)

    @cached_property
    def files(self) -> ScratchFiles | None:
        """This training's scratch files; None if there is no folder for them."""
        return ScratchFiles(self.scratch, self.owner, self.run) if self.scratch is not None else None

    @classmethod
    def _with_cache(cls, limit: int | None, cache: str | Path | None, run: Run | None) -> HostMemory:
        if cache is not None and str(cache) != NO_CACHE and (not str(cache) or Path(cache).is_file()):
            raise InputError(f"--cache {cache}: expected a folder, or none")
        if cache is None:
            return cls(limit, run.cache_path if run is not None and limit is not None else None)
        return cls(limit) if str(cache) == NO_CACHE else cls(limit, Path(cache), keeps_cache=True)

    def photographs(self, scene: Scene, config: TrainConfig) -> HostPhotographs:
        """Make the `HostPhotographs`, which keep a scene's training photographs in main memory."""
        store = DecodedStore(self.cache) if self.cache is not None else None
        views, factors = scene.require_training_views(), by_doubling(config.warmup).factors
        return HostPhotographs(Decoder(views, config.rounds_photos(len(views)), factors, store), config.batch)

    def check(self, scene: Scene, config: TrainConfig, device: Device) -> None:
        """Raise InputError if the limit is too small for the first step. Creates no files."""
        if self.limit is not None:
            count = len(scene.points) or config.random_points
            taken = count * model_bytes(config)
            if streams_by_chunk(config, device, count):
                taken = _least_pool(record_bytes(config, contributions=config.density.min_contribution > 0))
            taken *= device.shares_memory
            photographs = replace(self, cache=None).photographs(scene, config)  # a cache would create its folder
            self.share(photographs, count, taken, begins=True)

    def pool(self, photographs: HostPhotographs, count: int, record: int, *, begins: bool) -> int | None:
        """Return the bytes for the pool of a streamed model on a device that shares main memory. None if all chunks fit
        within the limit, or if there is no limit.

        count, record: number of Gaussians, and bytes of a Gaussian in a chunk.
        begins: True to raise InputError if the limit is too small for one chunk.
        """
        if self.limit is None or self.limit >= count * record + photographs.least:
            return None
        pool = (self.limit - photographs.least) * POOL_QUARTERS // 4
        if begins and pool < CHUNK_ROWS * record:
            raise self._too_little(photographs, count, _least_pool(record))
        return max(pool, CHUNK_ROWS * record)

    def scratch_file(self, nbytes: int, photographs: HostPhotographs) -> Path | None:
        """Return the path of a new scratch file for `nbytes` of chunks; None if main memory has room for them.

        Raises InputError if there is no folder for the file.
        """
        if not self.is_exceeded(nbytes, photographs):
            return None
        if self.files is None:
            raise InputError(
                f"--max-host-mem {amount(self.limit or 0)} has no room for {amount(nbytes)} of Gaussians: name a "
                "folder for a scratch file (--scratch DIR), or a run's folder (-o)"
            )
        return self.files.new_file()

    def is_exceeded(self, nbytes: int, photographs: HostPhotographs) -> bool:
        """Return True if main memory has no room for `nbytes` of chunks beside the minimum that photographs need."""
        return self.limit is not None and self.limit < nbytes + photographs.least

    def remove_scratch(self) -> None:
        """Remove this training's scratch files that no checkpoint names, such as those of a process that was killed."""
        if self.files is not None:
            self.files.remove_unnamed()

    def share(self, photographs: HostPhotographs, count: int, taken: int, *, begins: bool) -> bool:
        """Limit photographs to the memory that the Gaussians leave. Returns False if the photographs need more.

        count, taken: number of Gaussians, and their bytes on the host.
        begins: True to raise InputError in this case, with the smallest limit that is enough.
        """
        if self.limit is None:
            return True
        enough = self.limit - taken >= photographs.least
        if begins and not enough:
            raise self._too_little(photographs, count, taken)
        photographs.follow(self.limit - taken)
        return enough

    def _too_little(self, photographs: HostPhotographs, count: int, taken: int) -> InputError:
        least = -(-(taken + photographs.least) // 2**20)
        return InputError(
            f"--max-host-mem {amount(self.limit or 0)} is too little: the photographs need at least "
            f"{amount(photographs.least)}, and {count:,} Gaussians take {amount(taken)} of main memory; expected at "
            f"least {least}MiB"
        )

    def end(self, run: Run | None) -> None:
        """Remove RUN/cache after the training, unless the user named this folder as the cache."""
        if run is None or not run.cache_path.is_dir():
            return
        if not (self.keeps_cache and self.cache is not None and self.cache.resolve() == run.cache_path.resolve()):
            remove_decoded(run.cache_path)


def record_bytes(config: TrainConfig, *, contributions: bool) -> int:
    """Return the bytes of a Gaussian in a chunk: parameters, moments and statistics."""
    return MODELS * 4 * floats_of((config.sh_degree + 1) ** 2) + gaussian_bytes(contributions=contributions)


def _least_pool(record: int) -> int:
    """Return the bytes of main memory that a pool of one chunk needs. A pool gets only a share (POOL_QUARTERS) of the
    memory beyond the minimum for photographs, so the result is more than the bytes of a chunk.

    record: bytes of a Gaussian in a chunk.
    """
    return -(-CHUNK_ROWS * record * 4 // POOL_QUARTERS)


def most_in_view(gaussians: Gaussians, cameras: Iterable[Camera], config: TrainConfig) -> int:
    """Return the largest number of chunks that one camera may show. gaussians: a model in the order of its chunks."""
    measured = measured_sides(gaussians.means, gaussians.log_scales)
    table = BoundsTable(len(measured), MOST_MISSED_STEPS + STEPS_PER_MEASUREMENT)
    table.measure(np.arange(len(measured), dtype=np.uint32), measured)
    pictures = (PictureBorders.of(camera, config.rasterizer, 1.0) for camera in cameras)
    return max(len(table.seen(partial(visible, each))) for each in pictures)


UNLIMITED = HostMemory()
"""Main memory with no limit, no cache and no scratch files."""


class MemoryPlanner:
    """Plans the memory of a training before it begins and at each densification, and limits the rasterizer to it.

    begins: True until the first step. Until then too little main memory is an error, afterwards a warning.
    rows_in_view: largest number of rows in the chunks of one view so far, if the model is streamed by chunk.
    rows_in_step: the same for all views of a step.
    """

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        rasterizer: Rasterizer,
        photographs: ImageCache,
        memory: HostMemory,
        batch: Batch | None,
    ) -> None:
        self._scene, self._config, self._rasterizer = scene, config, rasterizer
        self._photographs, self._memory, self._batch = photographs, memory, batch
        self.begins, self._warned, self.rows_in_view, self.rows_in_step = True, False, 0, 0
        self._plan_replicas: Callable[[], None] = lambda: None
        """Function that plans the memory of a batch's further devices, for the latest number of Gaussians."""

    def look(self, local: Callable[[Camera], Camera], initial: Gaussians) -> None:
        """Set `rows_in_view` to the largest number of rows in the chunks of the initial model that one view may show.

        Only an even sample of the views is counted. `rows_in_step` counts as if views had no chunk in common. Both are
        0 if device memory has no limit, or if a model of this size is never streamed by chunk.
        local: function that converts a camera from world to model coordinates.
        initial: the model at the start, in the order of its chunks.
        """
        device, views = self._rasterizer.device, self._scene.views
        self.rows_in_view = self.rows_in_step = 0
        if device.memory.limit is not None and streams_by_chunk(self._config, device, len(initial)):
            cameras = [local(view.camera) for view in views[:: -(-len(views) // MOST_VIEWS_LOOKED_AT)]]
            chunks = most_in_view(initial, cameras, self._config)
            self.rows_in_view = CHUNK_ROWS * chunks
            self.rows_in_step = CHUNK_ROWS * min(chunks * self._config.batch, chunks_of(len(initial)))

    def plan(self, count: int, needs: StatisticsNeeds, components: Sequence[Component], turns: int) -> Plan:
        """Plan the memory for `count` Gaussians with their final number of SH coefficients.

        needs: statistics of density control.
        components: components of the training, which need memory too.
        turns: number of arrays of loss sums that steps use in turn (`stages.loss.loss`).
        Raises CapacityError, or InputError for too little main memory.
        """
        by_chunk = streams_by_chunk(self._config, self._rasterizer.device, count)
        on_host = self._rasterizer.device.shares_memory
        record = record_bytes(self._config, contributions=needs.contributions)
        memory = StepMemory(
            fields=slot_fields(needs, nearness=bool(self._config.depth_use)),
            photographs=sum(view.camera.width * view.camera.height for view in self._scene.train_views),
            turns=turns,
            masks=self._config.mask_use != NO_MASKS or any(view.ignores for view in self._scene.views),
            row_bytes=sum(component.row_bytes for component in components),
            pixel_bytes=sum(component.pixel_bytes for component in components),
            by_chunk=by_chunk,
            pool=self._memory.pool(self._photographs.host, count, record, begins=self.begins)
            if by_chunk and on_host
            else None,
            in_view=self.rows_in_view,
            in_step=self.rows_in_step,
        )
        models = max(component.models for component in components)
        usual = MODELS if self._batch is None else OWNER_ARRAYS_PER_PARAMETER
        made = self._plan(self._rasterizer.device, count, memory, models or usual)
        self._rasterizer.follow(made)
        self._photographs.follow(made.photographs)
        self._share_host(made, count)
        of = count, replace(memory, by_chunk=False, pool=None)
        self._plan_replicas = partial(self._follow_further, *of, by_chunk=by_chunk and made.streamed)
        self._plan_replicas()
        return made

    def _follow_further(self, count: int, memory: StepMemory, *, by_chunk: bool) -> None:
        """Plan the memory of the further devices of a batch.

        count: number of Gaussians of the model.
        by_chunk: True if the first device streams the model by chunk. A further device then gets at most `rows_in_view`
            rows, otherwise all Gaussians where a step runs over the whole model.
        """
        if self._batch is not None:
            rows = min(count, self.rows_in_view or count) if by_chunk else count
            devices = [each.device for each in self._batch.replicas]
            self._batch.follow([self._plan(each, rows, memory, REPLICA_ARRAYS_PER_PARAMETER) for each in devices])

    def plan_view(self, current: Plan, chunks: int, of_step: int) -> Plan:
        """Plan the device's memory for views that show up to `chunks` chunks, and steps that show up to `of_step`.

        current: the current plan of a model that is streamed by chunk. It is returned if it has room for so many
            chunks, or if memory was planned for as many before. After a CapacityError it stays valid.
        """
        shown, known = (chunks, of_step), (self.rows_in_view, self.rows_in_step)
        if all(CHUNK_ROWS * each <= max(rows, current.rows) for each, rows in zip(shown, known, strict=True)):
            return current
        plan = partial(plan_view, self._rasterizer.device, current)
        try:  # plan for a few more chunks, so that slightly larger views need no new plan
            planned = [max(CHUNK_ROWS * listed_chunks(each), rows) for each, rows in zip(shown, known, strict=True)]
            wider = plan(*planned)
        except CapacityError:
            planned = [max(CHUNK_ROWS * each, rows) for each, rows in zip(shown, known, strict=True)]
            wider = plan(*planned)
        self.rows_in_view, self.rows_in_step = planned
        self._rasterizer.follow(wider)
        self._plan_replicas()
        self._share_host(wider, wider.need.gaussians)
        return wider

    def scratch_file(self, nbytes: int) -> Path | None:
        """Return the path of a new scratch file for `nbytes` of chunks; None if main memory has room for them."""
        return self._memory.scratch_file(nbytes, self._photographs.host)

    @property
    def scratch_files(self) -> ScratchFiles | None:
        """The training's scratch files; None if there is no folder for them."""
        return self._memory.files

    def _plan(self, device: Device, count: int, memory: StepMemory, models: int) -> Plan:
        cameras, coefficients = [view.camera for view in self._scene.views], (self._config.sh_degree + 1) ** 2
        try:
            return plan_step(device, count, coefficients, cameras, self._config.rasterizer, memory, models=models)
        except CapacityError as error:
            whole = settings_of_whole_steps(self._config) if count > ORDERED_ROWS else []
            if not whole:
                raise
            raise CapacityError(
                f"{error}; without {', '.join(whole)}, steps need memory only for the Gaussians in view"
            ) from None

    def _share_host(self, plan: Plan, count: int) -> None:
        """Limit photographs to the main memory that the Gaussians leave. Warns once if this is too little."""
        need, photographs = plan.need, self._photographs.host
        taken = need.record * count if self._rasterizer.device.shares_memory or plan.streamed else 0
        if need.pool is not None:
            taken = need.record * plan.rows
        elif plan.streamed and need.held is not None and self.scratch_files is not None:
            taken *= not self._memory.is_exceeded(taken, photographs)  # a scratch file then takes all chunks
        enough = self._memory.share(photographs, count, taken, begins=self.begins)
        if not enough and not self._warned:
            self._warned = True
            warn(
                f"--max-host-mem is exceeded from here on: {count:,} Gaussians leave too little of it for photographs; "
                "--density.max-gaussians limits the number of Gaussians"
            )
