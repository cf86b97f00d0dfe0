# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables as others write them."""

import pytest

from calib_ros import Settings, read_table
from calib_ros.files import loading
from calib_ros.files.foreign import Foreign
from calib_ros.files.layouts import Layout


@pytest.fixture
def path(tmp_path):
    """Return the path of a table that is not yet written."""
    return tmp_path / 'cell.csv'


@pytest.fixture
def read(tmp_path):
    def read(text, name='cell.csv', joints=2, **layout):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_table(path, joints, foreign=Foreign(Layout(**layout)))

    return read


@pytest.fixture
def guessed(tmp_path, request):
    def guessed(text, name='cell.csv'):
        """Read the table of the module's ARM as the command line does, without options."""
        path = tmp_path / name
        path.write_text(text)
        return loading.table(path, request.module.ARM, Settings())

    return guessed
