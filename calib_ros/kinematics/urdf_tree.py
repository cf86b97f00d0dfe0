# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot description (URDF) as a tree of links and joints."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from calib_ros.errors import ConfigError, UnknownNameError
from calib_ros.kinematics.se3 import FloatArray

MOVING_TYPES = ('revolute', 'continuous', 'prismatic')
USUAL_TIPS = ('tool0', 'flange')


@dataclass(frozen=True, eq=False)
class DescribedJoint:
    """A joint of a URDF; `axis` is a unit vector in its frame, zero if fixed.

    It `follows` another joint, times a multiplier and plus an offset, if it mimics one.
    """

    name: str
    type: str
    parent: str
    child: str
    origin: FloatArray
    axis: FloatArray
    lower: float | None
    upper: float | None
    follows: tuple[str, float, float] | None

    @property
    def moves(self) -> bool:
        """Tell whether one number drives the joint."""
        return self.type in MOVING_TYPES


@dataclass(frozen=True, eq=False)
class Description:
    """A URDF: mass [kg] and centre (3,) [m] of its links, its joints from the root outwards."""

    name: str
    root: str
    links: dict[str, tuple[float, FloatArray]]
    joints: tuple[DescribedJoint, ...]

    def path(self, base: str | None, tip: str | None) -> tuple[DescribedJoint, ...]:
        """Return the joints from one link to another: by default from the root to the arm's end.

        Of joints that mimic one that is not among them, the first one leads the others. A joint
        that follows has equal limits.

        Raises ConfigError if no serial chain of joints connects them.
        """
        base = self.root if base is None else base
        for link in (base, tip):
            if link is not None and link not in self.links:
                raise UnknownNameError('link', link, self.links)
        tip = self._usual_tip(base) if tip is None else tip
        leading = {joint.child: joint for joint in self.joints}
        path: list[DescribedJoint] = []
        while (link := path[-1].parent if path else tip) != base:
            if link not in leading:
                before = ', '.join([link, *(joint.child for joint in reversed(path))])
                raise ConfigError(
                    f'no joints lead from link "{base}" out to link "{tip}": choose base_link '
                    f'among those before it, {before}'
                )
            path.append(leading[link])
        path.reverse()
        if not any(joint.moves for joint in path):
            raise ConfigError(f'no joint moves between link "{base}" and link "{tip}"')
        for joint in path:
            if joint.type in ('floating', 'planar'):
                raise ConfigError(
                    f'joint "{joint.name}" is {joint.type}: a serial chain has revolute, '
                    'continuous, prismatic and fixed joints only; choose base_link and tip_link '
                    'on one side of it'
                )
        leaders = {each.name: (each.name, 1.0, 0.0) for each in path if not each.follows}
        return tuple(self._as_mimic(joint, leaders) if joint.follows else joint for joint in path)

    def _as_mimic(
        self, joint: DescribedJoint, leaders: dict[str, tuple[str, float, float]]
    ) -> DescribedJoint:
        """Return a joint as it follows one of the `leaders`, or as the leader of its master."""
        known = {each.name: each for each in self.joints}
        master, ratio, offset = joint, 1.0, 0.0
        passed = []
        while master.follows:
            passed.append(master.name)
            name, times, more = master.follows
            if name not in known:
                raise UnknownNameError(f'joint "{master.name}": mimicked joint', name, known)
            if name in passed or not times:
                raise ConfigError(f'joint "{joint.name}" mimics itself, or another times zero')
            master, ratio, offset = known[name], ratio * times, offset + ratio * more
        leader, one, before = leaders.setdefault(master.name, (joint.name, ratio, offset))
        if leader == joint.name:
            return replace(joint, follows=None)
        offset -= ratio / one * before
        return replace(joint, lower=offset, upper=offset, follows=(leader, ratio / one, offset))

    def _usual_tip(self, base: str) -> str:
        behind, moved = {base}, dict[str, None]()
        for joint in self.joints:
            if joint.parent in behind:
                behind.add(joint.child)
                if joint.moves or joint.parent in moved:
                    moved[joint.child] = None
        for link in USUAL_TIPS:
            if link in moved:
                return link
        parents = {joint.parent for joint in self.joints}
        ends = [link for link in self.links if link in moved and link not in parents]
        if len(ends) == 1:
            return ends[0]
        usual = ([link for link in moved if link.endswith(name)] for name in USUAL_TIPS)
        prefixed = next((links for links in usual if links), ())
        if len(prefixed) == 1:
            return prefixed[0]
        found = f'ends in {", ".join(ends)}' if ends else f'moves nothing behind "{base}"'
        below = Counter(ends)
        for joint in reversed(self.joints):
            below[joint.parent] += below[joint.child]
        if forks := [link for link in moved if below[link] == len(ends)]:
            found += f', all behind {forks[-1]}'
        raise ConfigError(
            f'the URDF {found}: name the tip_link of the arm (calib_ros chain FILE '
            '--tip-link LINK --out arm.yaml; then --chain arm.yaml)'
        )

    def poses(self, base: str) -> dict[str, FloatArray]:
        """Return the frames (4, 4) of all links behind a base at zero, in the base."""
        poses = {base: np.eye(4)}
        for joint in self.joints:
            if joint.parent in poses:
                poses[joint.child] = poses[joint.parent] @ joint.origin
        return poses
