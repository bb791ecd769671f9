# SPDX-License-Identifier: Apache-2.0
"""Plans of a training's memory: the devices' for its steps, and the main memory's for Gaussians and photographs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from clsplat.config.masks import NO_MASKS
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.errors import warn
from clsplat.gaussians import floats_of
from clsplat.rendering.memory_needs import MODELS, StepMemory, plan_step
from clsplat.rendering.memory_plan import Plan
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.runs.scratch import ScratchFiles
from clsplat.scenes.scene import Scene
from clsplat.stages.density import gaussian_bytes
from clsplat.training.batch import OWNER_ARRAYS_PER_PARAMETER, REPLICA_ARRAYS_PER_PARAMETER, Batch
from clsplat.training.density import StatisticsNeeds
from clsplat.training.host_memory import HostMemory
from clsplat.training.step.component import Component
from clsplat.training.step.gradient_step import slot_fields
from clsplat.training.step.visible_chunks import streams_by_chunk
from clsplat.training.supervision.image_cache import ImageCache


class MemoryPlanner:
    """Plans the memory of a training, and gives its parts what the plans allow them.

    begins: True until the first step. Too little main memory is an error until then, and a warning later.
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
        self.begins, self._warned = True, False

    def plan(self, count: int, needs: StatisticsNeeds, components: Sequence[Component], turns: int) -> Plan:
        """Plan the memory for `count` Gaussians with their final number of SH coefficients.

        needs: statistics of density control.
        turns: number of arrays for the loss's sums (`stages.loss.loss`).
        Raises CapacityError, or InputError for too little main memory.
        """
        by_chunk = streams_by_chunk(self._config, self._rasterizer.device, count)
        on_host, held = self._rasterizer.device.shares_memory, gaussian_bytes(contributions=needs.contributions)
        model = MODELS * 4 * floats_of((self._config.sh_degree + 1) ** 2)
        memory = StepMemory(
            fields=slot_fields(needs, nearness=bool(self._config.depth_use)),
            photographs=sum(view.camera.width * view.camera.height for view in self._scene.train_views),
            turns=turns,
            masks=self._config.mask_use != NO_MASKS,
            row_bytes=sum(component.row_bytes for component in components),
            pixel_bytes=sum(component.pixel_bytes for component in components),
            by_chunk=by_chunk,
            pool=self._memory.pool(self._photographs.host, count, model, held, begins=self.begins)
            if by_chunk and on_host
            else None,
        )
        models = max(component.models for component in components)
        usual = MODELS if self._batch is None else OWNER_ARRAYS_PER_PARAMETER
        made = self._plan(self._rasterizer.device, count, memory, models or usual)
        self._rasterizer.follow(made)
        self._photographs.follow(made.photographs)
        self._share_host(made, count, held)
        if self._batch is not None:
            replicas = [replica.device for replica in self._batch.replicas]
            self._batch.follow([self._plan(each, count, memory, REPLICA_ARRAYS_PER_PARAMETER) for each in replicas])
        return made

    def scratch_file(self, nbytes: int) -> Path | None:
        """A new file for so many bytes of chunks; None if main memory has room for them. Raises InputError."""
        return self._memory.scratch_file(nbytes, self._photographs.host)

    @property
    def scratch_files(self) -> ScratchFiles | None:
        """The training's files of chunks; None if there is no folder for them."""
        return self._memory.files

    def _plan(self, device: Device, count: int, memory: StepMemory, models: int) -> Plan:
        cameras, coefficients = [view.camera for view in self._scene.views], (self._config.sh_degree + 1) ** 2
        return plan_step(device, count, coefficients, cameras, self._config.rasterizer, memory, models=models)

    def _share_host(self, plan: Plan, count: int, statistics: int) -> None:
        """Give the photographs the main memory that the Gaussians leave.

        statistics: bytes of statistics per Gaussian.
        """
        model = plan.need.model * (plan.rows if plan.need.pool is not None else count)
        on_host = self._rasterizer.device.shares_memory or plan.streamed
        taken = model + count * statistics if on_host else 0
        enough = self._memory.share(self._photographs.host, count, taken, begins=self.begins)
        if not enough and not self._warned:
            self._warned = True
            warn(
                f"--max-host-mem is exceeded from here on: {count:,} Gaussians leave too little of it for photographs; "
                "--density.max-gaussians limits the number of Gaussians"
            )
