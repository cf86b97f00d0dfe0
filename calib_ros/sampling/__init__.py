# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages in, matched samples out, live and replayed alike. No ROS."""
