# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a fit may be used, where, and what is wrong if not."""
