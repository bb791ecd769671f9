# SPDX-License-Identifier: Apache-2.0
"""`clsplat render`, from the call to the exit status.

`clsplat.cli.render.request` checks the flags. `clsplat.cli.render.job` reads cameras and models, and makes the tasks.
For --dry-run it prints them, else it has them rendered and written.
"""

from __future__ import annotations

from clsplat.cli.render.flags import RenderVerb
from clsplat.cli.session import Services
from clsplat.process import terminable

__all__ = ["RenderVerb", "run"]


def run(verb: RenderVerb, services: Services) -> int:
    """Render a model from cameras to images."""
    from clsplat.cli.render.job import dry_run, job_of, write_frames
    from clsplat.cli.render.request import checked

    request = checked(verb)
    job = job_of(request)
    renderers = [
        services.open_frame_renderer(
            job.models.drawn,
            job.options,
            verb.rasterizer,
            device=selector,
            memory_limit=request.memory_limit,
            profile=verb.profile,
            mattes=job.mattes,
            tested=not verb.dry_run,
        )
        for selector in (() if verb.on_farm else request.devices)
    ]
    if verb.dry_run:
        return dry_run(job, [renderer.memory_plan(job.tasks) for renderer in renderers])
    for renderer in renderers:
        renderer.check(job.tasks)
    with terminable():  # installed again: pycolmap and kernel compilers have installed handlers of their own
        return write_frames(job, renderers)
