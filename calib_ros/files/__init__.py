# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags, tables, journals, programs, exports: everything that is read or written."""
