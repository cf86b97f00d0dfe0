# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags, tables, journals, programs, exports: everything that is read or written.

What cannot be read raises an InputError that names the file and the line, what cannot be written
an OSError or, where something is in the way, an InputError.
"""
