# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a calibration is for: plan, compensate, verify, find the best place."""
