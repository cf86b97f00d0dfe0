# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags, tables, journals, programs, exports: all reading and writing.

Unreadable files raise an InputError with file and line; failed writes raise an OSError or, if
something is in the way, an InputError.
"""
