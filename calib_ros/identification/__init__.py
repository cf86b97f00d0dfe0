# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The method: `identify`, the choice of a model, the calibration, and what changed since."""
