# SPDX-License-Identifier: Apache-2.0
"""The viewer: a browser page that shows frames rendered by the OpenCL device (docs/viewer.md).

`pose`, `refinement`, `appearance` and `path_recorder` determine which pictures are shown, without OpenCL or viser.
`scheduler` lets one thread render for all viewers. `models` renders pictures of models.
`server` and `page` talk to the browser through viser.
"""
