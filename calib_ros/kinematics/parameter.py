# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The parameters of a chain, each a property of an owner: `elbow_joint.theta`, `tool.x`.

A parameter is its own name, so it serves as key, column heading and text in users' files at once.
"""

from __future__ import annotations

from functools import lru_cache

DH_KINDS = ('a', 'alpha', 'd', 'theta', 'beta')
ROW_KINDS = (*DH_KINDS, 'b')
"""Parameters of a joint's row; b is zero unless axes coincide."""
DH_ANGLES = ('alpha', 'theta', 'beta')
FRAME_KINDS = ('x', 'y', 'z', 'rx', 'ry', 'rz')
DELAY = 'delay'
"""Parameter [s] of a base frame: delay of the stamps of its device."""
LENS_KINDS = ('fx', 'fy', 'cx', 'cy', 'k1', 'k2', 'p1', 'p2', 'k3')
"""Parameters of a camera's frame, the first four in pixels."""
IN_PIXELS = LENS_KINDS[:4]

_UNITS = {
    **dict.fromkeys(('a', 'd', 'b', 'x', 'y', 'z', 'play', 'zero'), 'm'),
    DELAY: 's',
    **dict.fromkeys(LENS_KINDS, '1'),
    **dict.fromkeys(IN_PIXELS, 'px'),
    'ratio': '1',
    'coupling': '1',
    'gravity': 'rad/m',
    'compliance': 'rad/(N m)',
}


class Parameter(str):
    """A parameter: `Parameter('tool', 'x')`, or by name, `Parameter('tool.x')`."""

    __slots__ = ()

    def __new__(cls, *parts: str) -> Parameter:
        """Join owner and kind; a name is taken as it is."""
        return super().__new__(cls, '.'.join(parts))

    @property
    def owner(self) -> str:
        """Return the joint or frame."""
        return self.partition('.')[0]

    @property
    def kind(self) -> str:
        """Return the property; empty for a name without a dot."""
        return self.partition('.')[2]

    @property
    def effect(self) -> tuple[str, str]:
        """Return the kind of an effect and its reference: a joint, or a harmonic."""
        first, _, rest = self.kind.partition('_')
        return first, rest

    @property
    def is_length(self) -> bool:
        """Tell whether it is a length [m]."""
        return self.unit == 'm'

    @property
    def of_dh(self) -> bool:
        """Tell whether it is a Denavit-Hartenberg parameter."""
        return self.kind in ROW_KINDS

    @property
    def of_lens(self) -> bool:
        """Tell whether it belongs to a lens."""
        return self.kind in LENS_KINDS

    @property
    def unit(self) -> str:
        """Return the unit; '1' for a pure number."""
        return _unit(self)

    @property
    def small_unit(self) -> tuple[float, str]:
        """Return factor and unit in which errors are shown: thousandths, except of lenses."""
        if self.of_lens:
            return 1.0, self.unit
        return 1e3, '‰' if self.unit == '1' else f'm{self.unit}'


@lru_cache(maxsize=1024)
def _unit(name: Parameter) -> str:
    return _UNITS.get(name.kind) or _UNITS.get(name.effect[0], 'rad')


@lru_cache(maxsize=256)
def parameters_of(owner: str, kinds: tuple[str, ...] = FRAME_KINDS) -> tuple[Parameter, ...]:
    """Return parameters of one owner, by default those of a frame's place."""
    return tuple(Parameter(owner, kind) for kind in kinds)


IN_A_FRAME = len(FRAME_KINDS)
"""Parameters of a frame; base and tool alone explain nearly all of fewer poses."""
