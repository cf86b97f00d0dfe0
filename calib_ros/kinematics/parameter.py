# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The parameters of a chain, each an owner's property: `elbow_joint.theta`, `tool.x`.

A parameter is its own name, so that it is a key, a column's heading and what users write in files
all at once; what it says of itself is read from it here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

DH_KINDS = ('a', 'alpha', 'd', 'theta', 'beta')
ANGLES = ('alpha', 'theta', 'beta')
FRAME_KINDS = ('x', 'y', 'z', 'rx', 'ry', 'rz')
DELAY = 'delay'
"""Kind of parameter [s] of a base frame: how late the stamps of its device are."""
LENS_KINDS = ('fx', 'fy', 'cx', 'cy', 'k1', 'k2', 'p1', 'p2', 'k3')
"""Kinds of a camera's frame: the first four in pixels."""
IN_PIXELS = LENS_KINDS[:4]

_UNITS = {
    **dict.fromkeys(('a', 'd', 'x', 'y', 'z'), 'm'),
    DELAY: 's',
    **dict.fromkeys(LENS_KINDS, '1'),
    **dict.fromkeys(IN_PIXELS, 'px'),
    'ratio': '1',
    'coupling': '1',
    'gravity': 'rad/m',
    'compliance': 'rad/(N m)',
}


class Parameter(str):
    """A parameter: `Parameter('tool', 'x')`, or by its name, `Parameter('tool.x')`."""

    __slots__ = ()

    def __new__(cls, *parts: str) -> Parameter:
        """Join owner and kind; a name is taken as it is."""
        return super().__new__(cls, '.'.join(parts))

    @property
    def owner(self) -> str:
        """Return the joint or frame that has it."""
        return self.partition('.')[0]

    @property
    def kind(self) -> str:
        """Return what it is of its owner; empty for a name without a dot."""
        return self.partition('.')[2]

    @property
    def effect(self) -> tuple[str, str]:
        """Return the kind of an effect and what it refers to: a joint, or a harmonic."""
        first, _, rest = self.kind.partition('_')
        return first, rest

    @property
    def is_length(self) -> bool:
        """Tell whether it is a length [m]."""
        return self.unit == 'm'

    @property
    def of_dh(self) -> bool:
        """Tell whether it is one of a joint's Denavit-Hartenberg parameters."""
        return self.kind in DH_KINDS

    @property
    def of_lens(self) -> bool:
        """Tell whether it belongs to a camera's lens."""
        return self.kind in LENS_KINDS

    @property
    def unit(self) -> str:
        """Return its unit; '1' for a pure number."""
        return _unit(self)


@lru_cache(maxsize=1024)
def _unit(name: Parameter) -> str:
    return _UNITS.get(name.kind) or _UNITS.get(name.effect[0], 'rad')


def parameters_of(owner: str, kinds: Iterable[str] = FRAME_KINDS) -> tuple[Parameter, ...]:
    """Return parameters of one owner; those of a frame's place if no kinds are given."""
    return tuple(Parameter(owner, kind) for kind in kinds)


IN_A_FRAME = len(FRAME_KINDS)
"""Parameters of a frame's place; base and tool alone explain nearly all of fewer poses."""
