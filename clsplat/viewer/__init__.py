# SPDX-License-Identifier: Apache-2.0
"""The viewer: a page in the browser, whose picture the OpenCL device renders (docs/viewer.md).

`pose`, `refinement`, `appearance` and `path_recorder` are policy, without OpenCL and without viser; `scheduler` shares
the work of one thread among all viewers; `models` has the models that are shown; `server` and `page` speak to the
browser, by viser.
"""
