# SPDX-License-Identifier: Apache-2.0
"""Submits a shot to OpenCue: a layer whose tasks are chunks of frames, each one process that loads the model once.

    python opencue_render.py SHOW SHOT MODEL CAMERAS PATTERN 1-100 [FRAMES_PER_TASK]

Needs OpenCue's packages pyoutline and pycue, and CUEBOT_HOSTS. Paths are those of the farm's machines.
"""

import sys

import outline
import outline.cuerun
import outline.modules.shell


def main(show: str, shot: str, model: str, cameras: str, pattern: str, frames: str, chunk: str = "10") -> None:
    """Make the job and launch it."""
    job = outline.Outline(f"clsplat_{shot}", shot=shot, show=show, frame_range=frames)
    # #FRAMESPEC# is the chunk as a list of frames: unlike #FRAME_END# it never goes beyond the range
    command = ["clsplat", "render", model, "--cameras", cameras, "-o", pattern, "--frames=#FRAMESPEC#"]
    command += ["--channels", "rgb,alpha,depth", "--exr", "half", "--skip-existing", "--progress", "json"]
    layer = outline.modules.shell.Shell("render", command=command, range=frames, chunk=int(chunk), threads=4)
    job.add_layer(layer)
    outline.cuerun.launch(job, use_pycuerun=False)


if __name__ == "__main__":
    main(*sys.argv[1:])
