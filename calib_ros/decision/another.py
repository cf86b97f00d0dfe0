# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Are new poses those of another robot of the same type?

Three bent links explain nearly any few poses. Another robot is no change of this one: its
parameters differ from nominal, and its frames from these, by errors e of one size, which the data
tell. The change is x = m + G e, with m from this arm to nominal. Given the information A, b about
x (`changes.py`), the log evidence is b^T m - m^T A m / 2 and that of e by A, b - A m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros.decision.changes import ChangeColumns, Explanation, Information
from calib_ros.estimation.sizes import SPREAD
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import FRAME_KINDS


def is_another(
    information: Information,
    columns: ChangeColumns,
    changed: Sequence[Sequence[Explanation]],
    arm: Chain,
    nominal: Chain,
) -> bool:
    """Tell whether another robot is likelier than an arm that changed so; frames may do both."""
    times = {n: each.times for reasons in changed for each in reasons for n in each.names}
    if not times:
        return False
    of_frames = {name: each for name, each in times.items() if name.kind in FRAME_KINDS}
    every = [n for n in information.names if n.of_dh or n.kind in FRAME_KINDS]
    mean = np.array([n.of_dh and -arm.offset(n, nominal) for n in information.names])
    force = information.matrix @ mean
    about = replace(information, vector=information.vector - force)
    sizes = (SPREAD ** np.linspace(-1.0, 0.5, 4)).tolist()
    roots = [columns.root(dict.fromkeys(every, size) | of_frames) for size in sizes]
    most = about.evidence(np.array(roots)).max()
    another = mean @ (information.vector - 0.5 * force) + most
    return bool(another > information.evidence(columns.root(times)[np.newaxis])[0])
