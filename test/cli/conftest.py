# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import pytest
from measured import measured, rows_of, write_csv


@pytest.fixture
def table(tmp_path):
    return write_csv(tmp_path / 'cell.csv', rows_of(measured()))
