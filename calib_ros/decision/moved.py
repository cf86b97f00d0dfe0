# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What moved during the session, in words (`steps.py` finds it)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from calib_ros.decision.reasons import Reason, Rule
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.settings import Settings
from calib_ros.shown import are_lines, moment, rows_in_words, two_digits

ZERO = 'zero'  # of the distances of a device
FRAMES = ('base', 'tool')
IN_THE_CELL = (*FRAMES, ZERO)  # beside the arm
ZEROS = ('joint', ZERO)
FROM_THERE, BEFORE_THAT, ASIDE = 'from there on', 'before that', 'with it elsewhere'
IF_IN_ORDER = ' (if rows are in the order of measurement)'
RELEASE = 'correct it, or remove fixed: true there'
"""What to do with a frame that the chain file holds in a wrong place."""
OF_THE_ARM = {'load': 'the load of the arm', 'joints': 'the zeros of several joints'}


@dataclass(frozen=True)
class Step:
    """What moved, when and by how much.

    Base or tool frames, the zeros of distances, a joint, all joints or the load (`kind`: 'base',
    'tool', 'zero', 'joint', 'joints' or 'load'), of these `owners`; `thing` names the device or
    target there. `set`, `sample` and `stamp_ns` belong to the first sample after the step, which a
    reader finds at `where`. `size` is the RMS change of positions ('m') or, if that weighs more,
    orientations ('rad'); of a zero its own, with its sign. `share` is its share of the squared
    residuals beyond that of as many useless parameters. If all measurements on one side are
    outliers, `unused` says which: the fit of frames is not affected. If the arm's places before
    and after lie `apart`, its errors may look like a step of that size. So do those of the joint
    `turned`, which seldom moved but did just before: a true step is hardly there by chance.
    """

    owners: tuple[str, ...]
    kind: str
    thing: str
    set: int
    sample: int
    stamp_ns: int
    size: float
    unit: str
    share: float
    unused: str
    where: str
    apart: bool = False
    turned: str = ''
    instead: str = ''
    """What `looks_alike`, if the zero of a joint moved."""
    held: bool = False
    """Whether a frame that the chain file holds is wrong from the first pose on."""
    slow: bool = False
    """Whether it crept over the whole session."""
    spoils: bool = False
    """Whether the correction therefore hardly helps where it began, or where it ended."""
    longer: Mapping[str, float] = field(default_factory=dict)
    """By how much [m] the distances of devices are longer from there on, if their zeros moved."""
    later: tuple[Step, ...] = ()
    """Further steps of the same owners."""

    @property
    def what(self) -> str:
        """Return the owners in words."""
        return ', '.join(self.owners)

    @property
    def harmful(self) -> bool:
        """Tell whether the step spoils the fit: it mixes two arms, or describes a past one."""
        return self.spoils if self.slow else self.kind not in IN_THE_CELL or not self.unused

    def __str__(self) -> str:
        return str(self.reason)

    @property
    def outdated(self) -> bool:
        """Tell whether the frame found is that before the step."""
        return self.kind in FRAMES and self.unused == FROM_THERE and not self.slow

    @property
    def _size(self) -> str:
        """Return the size in words; only of several with its sign; large angles in degrees.

        Zero if only gross errors tell it.
        """
        size = math.remainder(self.size, 2.0 * math.pi) if self.unit == 'rad' else self.size
        size = size if self.later else abs(size)
        if not self.size:
            return 'by an unknown amount'
        if self.unit == 'rad' and abs(size) > Settings.largest_angle:
            return f'by {math.degrees(size):.0f}°'
        return f'by {two_digits(1e3 * size)} m{self.unit}'

    @property
    def _where(self) -> str:
        """Return where it moved, and where by how much again."""
        text = self.where.removesuffix(IF_IN_ORDER)
        for each in self.later:
            by = f'{replace(each, later=(self,))._size} ' * (self.kind not in OF_THE_ARM)
            text += f', {by}before {each.where.removesuffix(IF_IN_ORDER)}'
        return text + IF_IN_ORDER * self.where.endswith(IF_IN_ORDER)

    @property
    def _are(self) -> str:
        return 'are' if len(self.owners) > 1 else 'is'

    @property
    def _correction(self) -> str:
        """Return how to make distances before and after alike."""
        after, parts = self.unused != BEFORE_THAT, []
        for wire, longer in self.longer.items():
            less = (longer > 0.0) == after
            how = ('subtract', 'from') if less else ('add', 'to')
            parts.append(f'{how[0]} {1e3 * abs(longer):.3g} mm {how[1]} the distances of {wire}')
        return f'{" and ".join(parts)} {FROM_THERE if after else BEFORE_THAT}'

    def told(self, number: int) -> str:
        """Return what moved in short, for an operator of the node who counts poses so."""
        again = ', measure again after ~/clear'
        what = f'the zero of {self.what}' if self.kind in ZEROS else self.what
        if self.slow:
            advice = f'see why{again}' if self.spoils else 'mix the order of poses'
            return f'{what} seems to move slowly, {self._size} in all: {advice}'
        if self.kind in OF_THE_ARM:
            return f'{OF_THE_ARM[self.kind]} changed before pose {number}{again}'
        moved = f'moved {self._size} before pose {number}' + ' and later again' * bool(self.later)
        if self.outdated:
            return f'{what} {moved} and {self._are} outdated{again}'
        return f'{what} {moved}' + again * self.harmful

    @property
    def reason(self) -> Reason:
        """Return the reason to refuse a result."""
        size = self._size
        if self.held:
            off = f'the {self.what} held by the chain file {self._are} off {size}'
            return Reason(Rule.MISTAKE, f'{off}: {RELEASE}')
        thing, of = self.thing, f' ({self.what})'
        if self.kind in ZEROS:
            thing, of = f'the zero of {self.what}', ''
        text = f'{thing} moved {size}{of} before {self._where}'
        more = f'; or {self.instead}' * bool(self.instead)
        if self.slow:
            text = f'{thing} seems to have moved slowly, {size} over the session{of}'
            if self.kind == 'joint':
                more += '; the correction is now off by half of that: see why, and measure again'
            more += '; if the poses follow an order, arm errors may look like this: mix them'
        elif self.kind in OF_THE_ARM:
            text, more = f'{thing} changed before {self._where}', f': poses differ {size}'
        if self.kind == 'load':
            more += '; measure with one load, or fit only the poses before or only those after'
        if self.unused:
            more += f'; measurements {self.unused} carry no weight'
            more += f': {self.what} {self._are} outdated, measure again' * self.outdated
        if self.later and self.kind in FRAMES:
            several = 'device' if self.kind == 'base' else 'target'
            more += f'; if these are several {several}s, name each (column {several}, or sources)'
        if self.longer and not (self.slow or self.later):
            more += f'; {self._correction}'
        if self.turned:
            more += f'; errors of {self.turned} may look so, as it moved just there: mix poses'
        elif self.apart:
            more += (
                '; arm errors may look like this, as poses before and after lie apart: mix them'
            )
        return Reason(Rule.ENCODER if self.kind.startswith('joint') else Rule.MOVED, text, more)


def name_of(problem: Problem, number: int, sample: int) -> str:
    """Return how a sample of any set is found: its time, its line, or its number in the set."""
    seen, fitted = problem.all_sets[number], len(problem.sets)
    stamp, what = seen.stamps_ns[sample], 'pose' if seen.pixels is None else 'image'
    if problem.of_messages:
        return f'the {what} of {moment(stamp)}'
    count = sample if seen.pixels is None else seen.images[sample]
    where = 'held-out ' * (number >= fitted) + f'{what} {count + 1}'
    where += f' of set {number + 1}' * (0 < number < fitted)
    if not are_lines(seen.stamps_ns):
        return f'{where} (stamp {moment(stamp)})'
    line = rows_in_words([sample], seen.stamps_ns)
    if sum(stamp in each.stamps_ns for each in problem.all_sets) > 1:  # of arrays, not a table
        return where
    return line if seen.pixels is None else f'{where}, {line}'


def place_of(problem: Problem, number: int, sample: int) -> str:
    """Return where a step is, by the first sample of a set after it."""
    known = problem.of_messages or not are_lines(problem.sets[number].stamps_ns)
    return name_of(problem, number, sample) + IF_IN_ORDER * (not known)


def looks_alike(problem: Problem, owner: str) -> str:
    """Return what turns, or slides, as the zero of the first or of the last joint does."""
    first, last = problem.chain.joints[0], problem.chain.joints[-1]
    kind, joint = ('tool', last) if owner == last.name else ('base', first)
    if owner != joint.name or len({getattr(each, kind) for each in problem.sets}) > 1:
        return ''
    how = 'turned about' if joint.type == 'revolute' else 'slid along'
    return f'{thing_of(kind, problem.sets[0], bodily=True)} {how} the axis of this joint'


def thing_of(kind: str, seen: Observations, several: bool = False, bodily: bool = False) -> str:
    """Return what moves with a frame, or with several alike, in words; `kind` as in `Step`.

    Only what moves `bodily`, without what seems to as the device's zero or clock does.
    """
    if kind not in IN_THE_CELL:
        return OF_THE_ARM.get(kind, 'the joint')
    of_images = seen.pixels is not None
    target = ['the board' if of_images else 'the target']
    device = ['the camera', 'its lens'] if of_images else ['the measuring device']
    if seen.socket or seen.plane:
        device = ['the socket' if seen.socket else 'the plane']
    elif seen.distances is not None:
        device += ['its zero']
    elif seen.moving:  # early or late is elsewhere
        device += ['its clock']
    device = device[:1] if bodily else device
    on_flange, other = (device, target) if seen.inverse or seen.on_flange else (target, device)
    other = [f'{other[0]}s'] if several else other
    *first, last = on_flange if kind == 'tool' else [*other, "the robot's foot"]
    return f'{", ".join(first)} or {last}' if first else last
