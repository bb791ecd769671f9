# SPDX-License-Identifier: Apache-2.0
"""`clsplat render`, from its flags to its exit status.

`clsplat.cli.render.request` checks the flags. `clsplat.cli.render.job` reads cameras and models, and makes a task for
each frame. With --dry-run it prints the tasks, otherwise it renders and writes their frames.
"""

from __future__ import annotations

from clsplat.cli.render.flags import RenderVerb
from clsplat.cli.session import Services
from clsplat.process import terminable

__all__ = ["RenderVerb", "run"]


def run(verb: RenderVerb, services: Services) -> int:
    """Render a model to an image for each camera, or print the plan with --dry-run."""
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
    with terminable():  # install signal handlers again, as pycolmap and kernel compilers replace them
        return write_frames(job, renderers)
