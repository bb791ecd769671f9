# SPDX-License-Identifier: Apache-2.0
"""A fixture of the tests of `clsplat render`."""

from __future__ import annotations

import pytest
from rendered import shot_of_a_model


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A model and a camera that goes to the right, as arguments of render."""
    return shot_of_a_model(tmp_path_factory.mktemp("shot"))
