# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The command line, as `python -m calib_ros`."""

import sys

from calib_ros.start import command_line

if __name__ == '__main__':
    sys.exit(command_line())
