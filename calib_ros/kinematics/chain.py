# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The serial chain in Denavit-Hartenberg parameters, and its forward kinematics.

    T_world_target(q) = T_world_base A_1(q_1) ... A_n(q_n) T_flange_target

    standard   A = Rz(theta) Tz(d) L    Vacarescu et al., eq. (2), with beta
    modified   A = L Rz(theta) Tz(d)    Craig
               L = Tx(a) Ty(b) Rx(alpha) Ry(beta)

    revolute   theta = joint.theta + sign q        prismatic   d = joint.d + sign q

The joint value q is the reported one plus the non-geometric effects of the chain (`effects.py`).

A chain is a sequence of elementary motions, each along or about one axis of the moving frame. A
walk along it (`walk.py`) ends in the pose, and the axes met on the way are all that the error
model (`jacobian.py`) needs.

beta is Hayati's parameter (Hayati and Mirmirani 1985; Vacarescu et al., section 2). It replaces d
at consecutive parallel axes, where a tiny tilt moves the common normal arbitrarily far. b replaces
theta where they coincide as well: a turn about the first axis does not shift the second.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal, TypeAlias, TypeVar, get_args

import numpy as np

from calib_ros.arrays import array_of
from calib_ros.errors import CalibrationError, ConfigError, InputError, UnknownNameError
from calib_ros.kinematics import effects, se3
from calib_ros.kinematics.joint import (
    ANYWHERE,
    Frame as Frame,
    Joint as Joint,
    JointType as JointType,
)
from calib_ros.kinematics.parameter import (
    DELAY,
    DH_KINDS,
    FRAME_KINDS,
    LENS_KINDS,
    ROW_KINDS,
    Parameter,
    parameters_of,
)
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.kinematics.walk import BLOCK, Walk
from calib_ros.shown import Shown

Convention: TypeAlias = Literal['standard', 'modified']

PARALLEL_TOLERANCE = np.radians(5.0)
"""Axes closer than this are treated as parallel: their common normal is badly determined."""


def nearly_parallel(tilt: float, apart: float) -> bool:
    """Tell whether axes are better described by beta than by d.

    From the sine of their angle f and how far apart [m] they are. Errors of the usual sizes (0.5
    mm, 1 mrad, so 0.5 m) turn the common normal 1 / sin f times as much, and the line to where the
    next axis pierces the plane across this one (0.5 m / apart) / cos f times.
    """
    near = tilt < max(math.sin(PARALLEL_TOLERANCE), _across(tilt, apart))
    return near or nearly_coincident(tilt, apart)


def nearly_coincident(tilt: float, apart: float) -> bool:
    """Tell whether axes are better described by b, too, than by theta.

    Beta and b exaggerate no error, so this holds up to an angle at which d is still tolerable.
    """
    close = _across(tilt, apart) < math.sin(PARALLEL_TOLERANCE)
    return close and tilt < math.sin(3.0 * PARALLEL_TOLERANCE)


def _across(tilt: float, apart: float) -> float:
    return min(2.0 * apart, 1.0) * math.sqrt(max(1.0 - tilt**2, 0.0))


@dataclass(frozen=True, eq=False, repr=False)
class Chain(Shown):
    """A serial chain; immutable: offsets return a new one."""

    name: str
    convention: Convention
    joints: tuple[Joint, ...]
    parallel: tuple[str, ...] | None = None
    """Joints whose row joins two parallel axes, where beta is fitted instead of d. By default
    found from the nominal table."""
    base: Frame | None = None
    tool: Frame | None = None
    """T_world_base and T_flange_target; None if unknown."""
    frames: tuple[tuple[str, Frame | None], ...] = ()
    """Further bases (`base_...`) and tools (`tool_...`), for several sessions or targets."""
    effects: tuple[tuple[str, float], ...] = ()
    """Non-geometric effects by name, with their values."""
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """Acceleration of gravity [m/s^2] in the base frame, for compliance."""

    def __post_init__(self) -> None:
        if self.convention not in get_args(Convention):
            raise UnknownNameError('convention', self.convention, get_args(Convention))
        if not self.joints:
            raise ConfigError(f'chain "{self.name}" has no joints')
        names = self.joint_names
        for name in names:
            if names.count(name) > 1:
                raise ConfigError(f'chain "{self.name}" has two joints named "{name}"')
            if name in self.all_frames:
                raise ConfigError(f'a joint must not be named "{name}", the name of a frame')
        if self.parallel is None:
            object.__setattr__(self, 'parallel', self._joining(nearly_parallel))
        for name in self.parallel or ():
            if name not in names:
                raise UnknownNameError('"parallel": joint', name, names)
            if (self.parallel or ()).count(name) > 1:
                raise ConfigError(f'"parallel" names joint "{name}" twice')

    def _joining(self, related: Callable[[float, float], bool]) -> tuple[str, ...]:
        """Return the joints whose row joins two axes that are `related` by tilt and distance.

        Two prismatic axes have no distance. Row i leads from axis i to the next in the standard
        convention, and to axis i in the modified one.
        """
        rows = self.joints[self.convention == 'modified' :]
        return tuple(
            row.name
            for row, *axes in zip(rows, self.joints, self.joints[1:], strict=False)
            if related(row.tilt, row.apart if any(j.type == 'revolute' for j in axes) else 0.0)
        )

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Return the names of the joints, in order."""
        return tuple(joint.name for joint in self.joints)

    @cached_property
    def held(self) -> Mapping[int, float]:
        """Return the values [rad or m] of joints with equal limits, by number.

        They never move, or only by couplings; their reported values are ignored.
        """
        ends = ((k, joint.lower, joint.upper) for k, joint in enumerate(self.joints))
        return {k: lower for k, lower, upper in ends if lower is not None and lower == upper}

    @cached_property
    def parameter_names(self) -> tuple[Parameter, ...]:
        """Return the names of all parameters of the error model, frames first."""
        frames = {name: self.frame(name) for name in self.frame_names}
        names = [name for frame in frames for name in parameters_of(frame)]
        names += [Parameter(name, DELAY) for name in frames if frames[name].delay is not None]
        cameras = [name for name in frames if frames[name].lens is not None]
        names += [name for camera in cameras for name in parameters_of(camera, LENS_KINDS)]
        parallel = frozenset(self.parallel or ())
        coincident = self._joining(nearly_coincident)
        for joint in self.joints:  # theta comes last if it trades against beta and b
            beside = joint.name in parallel and (joint.name in coincident or joint.b != 0.0)
            left_out = 'd' if joint.name in parallel else 'beta', '' if beside else 'b'
            own = [name for name in joint.parameters if name.kind not in left_out]
            names += sorted(own, key=lambda name: name.kind == 'theta') if beside else own
        return (*names, *(Parameter(name) for name, _ in self.effects))

    @cached_property
    def frame_names(self) -> tuple[str, ...]:
        """Return the names of all base and tool frames."""
        return tuple(self.all_frames)

    @property
    def table(self) -> FloatArray:
        """Return the DH table (n, 5) with columns a, alpha, d, theta, beta; (n, 6) with b."""
        return self._numbers(self.columns)

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the columns of the table; b only where it is not zero."""
        return ROW_KINDS if any(joint.b for joint in self.joints) else DH_KINDS

    def _numbers(self, kinds: Sequence[str]) -> FloatArray:
        return np.array([[getattr(joint, kind) for kind in kinds] for joint in self.joints])

    @cached_property
    def walk(self) -> Walk:
        """Return the link data for the forward kinematics."""
        signs = np.array([float(joint.sign) for joint in self.joints])
        turning = np.array([joint.type == 'revolute' for joint in self.joints])
        return Walk(self._numbers(ROW_KINDS), signs, turning, self.convention == 'standard')

    def value(self, name: str) -> float:
        """Return a parameter's value [m or rad]; a frame's rotation as a rotation vector."""
        if name in self._effect_values:
            return self._effect_values[name]
        if name not in self.all_parameters:
            raise UnknownNameError('parameter', name, self.parameter_names)
        owner, _, kind = name.partition('.')
        if owner in self._joints:
            return float(getattr(self._joints[owner], kind))
        frame = self.frame(owner)
        if kind == DELAY:
            return frame.delay or 0.0
        if kind in LENS_KINDS:
            return 0.0 if frame.lens is None else float(getattr(frame.lens, kind))
        return float(frame.offsets()[FRAME_KINDS.index(kind)])

    def offset(self, name: str, nominal: Chain) -> float:
        """Return the offset from a nominal chain, as for `with_offsets`."""
        owner, _, kind = name.partition('.')
        if owner not in self.all_frames or kind not in FRAME_KINDS:
            return self.value(name) - nominal.value(name)
        return float(self.frame(owner).offsets(nominal.frame(owner))[FRAME_KINDS.index(kind)])

    def frame(self, name: str) -> Frame:
        """Return a base or tool frame; the identity if unknown."""
        if name not in self.all_frames:
            raise UnknownNameError('frame', name, self.frame_names)
        return self.all_frames[name] or ANYWHERE

    def owns_frame(self, parameter: str) -> bool:
        """Tell whether a parameter belongs to a base or tool frame."""
        return parameter.partition('.')[0] in self.all_frames

    def with_frame(self, name: str, frame: Frame) -> Chain:
        """Return the chain with a replaced or added frame."""
        kept = ('joint_names', 'walk', 'held', '_joints', '_effect_values')
        if name in ('base', 'tool'):
            return _with(self, {name: frame}, (*kept, 'frame_names', 'all_parameters'))
        return _with(self, {'frames': tuple((dict(self.frames) | {name: frame}).items())}, kept)

    def with_effects(self, names: Sequence[str]) -> Chain:
        """Return the chain with further effects of value zero."""
        added = [name for name in dict.fromkeys(names) if name not in self._effect_values]
        if not added:
            return self
        for name in added:
            if name.partition('.')[0] not in self._joints:
                raise UnknownNameError('parameter', name, self.parameter_names)
            effects.resolve(self, name)
        kept = ('joint_names', 'frame_names', 'walk', 'all_frames', '_joints', 'held')
        return _with(self, {'effects': (*self.effects, *((name, 0.0) for name in added))}, kept)

    def with_effect_values(self, values: Mapping[str, float]) -> Chain:
        """Return the chain with effects of given values."""
        return self.with_effects(tuple(values)).with_offsets(values) if values else self

    def with_offsets(self, offsets: Mapping[str, float]) -> Chain:
        """Return the chain with offsets [m or rad] added to the named parameters.

        Errors are added to parameters, not to transforms: the paper's A + dA leaves SE(3).
        """
        by_owner: dict[str, dict[str, float]] = {}
        for name, offset in offsets.items():
            if name not in self.all_parameters:
                raise UnknownNameError('parameter', name, self.parameter_names)
            if not math.isfinite(offset):
                raise ConfigError(f'the offset of {name} must be a finite number')
            owner, _, kind = name.partition('.')
            by_owner.setdefault(owner, {})[kind] = float(offset)
        joints = []
        for joint in self.joints:
            own = by_owner.get(joint.name, {})
            values = {kind: getattr(joint, kind) + own[kind] for kind in own if kind in ROW_KINDS}
            joints.append(_with(joint, values, ('parameters', 'driven')) if values else joint)
        frames = {
            key: self.frame(key).moved(by_owner[key]) if key in by_owner else frame
            for key, frame in self.all_frames.items()
        }
        found: dict[str, object] = {
            'joints': tuple(joints),
            'base': frames.pop('base'),
            'tool': frames.pop('tool'),
            'frames': tuple(frames.items()),
            'effects': tuple((n, v + float(offsets.get(n, 0.0))) for n, v in self.effects),
        }
        same = all(new is old for new, old in zip(joints, self.joints, strict=True))
        names = ('joint_names', 'frame_names', 'all_parameters', 'held')
        kept = (*names, *(('walk', '_joints') if same else ()))
        return _with(self, found, kept)

    def forward(
        self,
        q: FloatArray,
        approach: FloatArray | None = None,
        base: str = 'base',
        tool: str = 'tool',
    ) -> FloatArray:
        """Return T_world_target (N, 4, 4) for joint values (N, n) [rad or m].

        `approach` (N, n) holds the signs of the preceding velocities, for backlash; `base` and
        `tool` select frames.
        """
        q = self.joint_values(q)
        found = np.empty((len(q), 4, 4))
        for start in range(0, len(q), BLOCK):
            part = slice(start, start + BLOCK)
            signs = None if approach is None else np.ascontiguousarray(approach[part].T)
            axes, origin = self.trace(np.ascontiguousarray(q[part].T), signs, base, tool)
            found[part] = se3.transform(axes.transpose(2, 1, 0), origin.T)
        return found

    def joint_values(self, q: FloatArray) -> FloatArray:
        """Return joint values (N, n) as an array; refuse any other shape."""
        q = array_of(q, np.float64, 'joint values')
        if q.ndim != 2 or q.shape[1] != len(self.joints):
            raise InputError(
                f'joint values must have the shape (N, {len(self.joints)}) for chain '
                f'"{self.name}", not {q.shape}'
            )
        return q

    def effective(self, q: FloatArray, approach: FloatArray | None = None) -> FloatArray:
        """Return the effective joint values (n, B) for reported ones (n, B)."""
        names = tuple(name for name, value in self.effects if value)
        return effects.moved_joints(self, names, effects.basis(self, names, q, approach), q)

    def trace(
        self,
        q: FloatArray,
        approach: FloatArray | None = None,
        base: str = 'base',
        tool: str = 'tool',
    ) -> tuple[FloatArray, FloatArray]:
        """Return the target's axes (3, 3, B) and origin (3, B) [m] in the world.

        As `forward`, at joint values (n, B); `axes[k]` is axis k.
        """
        frames = np.empty((len(q) + 1, 4, 3, q.shape[1]))
        self.walk.frames(self.effective(q, approach), self.frame(base).matrix, frames)
        target = self.at_the_tool(frames[-1], tool)
        return target[:3], target[3]

    def at_the_tool(self, flange: FloatArray, tool: str) -> FloatArray:
        """Return the frame (4, 3, B) of a tool, given the flange's (4, 3, B)."""
        end = self.frame(tool).matrix
        return np.asarray((end.T @ flange.reshape(4, -1)).reshape(flange.shape))

    def random_joints(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draw joint values (count, n) within the range of each joint."""
        lower, upper = np.array([joint.range for joint in self.joints]).T
        return rng.uniform(lower, upper, (count, len(self.joints)))

    @cached_property
    def all_parameters(self) -> frozenset[str]:
        """Return all possible parameter names of joints, frames and effects."""
        return _parameters(self.joint_names, self.frame_names, tuple(self._effect_values))

    @cached_property
    def all_frames(self) -> Mapping[str, Frame | None]:
        """Return base, tool and further frames by name; None if unknown."""
        return {'base': self.base, 'tool': self.tool, **dict(self.frames)}

    @cached_property
    def _joints(self) -> Mapping[str, Joint]:
        return {joint.name: joint for joint in self.joints}

    @cached_property
    def _effect_values(self) -> Mapping[str, float]:
        return dict(self.effects)


def refuse_other_joints(
    what: str, chain: Chain, whose: str, other: Chain, error: type[CalibrationError] = ConfigError
) -> None:
    """Refuse a chain with other joints than another one, each named by what it is."""
    ours, theirs = (
        ', '.join(f'{joint.name} ({joint.type})' for joint in each.joints)
        for each in (chain, other)
    )
    if ours != theirs:
        raise error(f'{what} has the joints {ours}; {whose} has {theirs}: are they the same arm?')


@lru_cache(maxsize=64)
def _parameters(
    joints: tuple[str, ...], frames: tuple[str, ...], fitted: tuple[str, ...]
) -> frozenset[str]:
    placed = (*FRAME_KINDS, DELAY, *LENS_KINDS)
    return frozenset(
        (
            *(f'{frame}.{kind}' for frame in frames for kind in placed),
            *(f'{joint}.{kind}' for joint in joints for kind in ROW_KINDS),
            *fitted,
        )
    )


Value = TypeVar('Value', Joint, Chain)


def _with(value: Value, changes: Mapping[str, object], kept: Sequence[str]) -> Value:
    """Return a changed value without repeating its checks, with the `kept` cached properties."""
    found = object.__new__(type(value))
    known = vars(value)
    vars(found).update({name: known[name] for name in value.__dataclass_fields__})
    vars(found).update({name: known[name] for name in kept if name in known} | dict(changes))
    return found
