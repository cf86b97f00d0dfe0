# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Many robots at once: what is to be done, the run, alarms, and its report."""
