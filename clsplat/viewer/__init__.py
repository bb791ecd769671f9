# SPDX-License-Identifier: Apache-2.0
"""The viewer: a browser page that shows frames rendered by the OpenCL device (docs/viewer.md).

`pose`, `refinement`, `appearance` and `path_recorder` decide what is shown. They use neither OpenCL nor viser.
`scheduler` divides one thread's work among all viewers. `models` renders the models that are shown.
`server` and `page` talk to the browser through viser.
"""
