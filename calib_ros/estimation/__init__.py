# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A chain and observations in, fitted parameters with their covariance out."""
