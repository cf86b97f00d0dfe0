# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements from the transforms on /tf and /tf_static.

A source names two frames. Exactly one link between them must move; static links before and after
it, in either direction, are composed with it at its stamps. Several moving links are refused: at
one moment only one of them is known, and mostly they are the robot's own joints, which would
measure the robot with itself.
"""

from __future__ import annotations

import shlex
from collections import Counter, defaultdict, deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from calib_ros.errors import MOST_ENTRIES
from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.account import Lost
from calib_ros.sampling.message_layout import Layouts
from calib_ros.sampling.messages import TRANSFORMS, short_type
from calib_ros.sampling.slices import Part
from calib_ros.sampling.sources import Source
from calib_ros.sampling.usable import usable
from calib_ros.settings import Settings
from calib_ros.shown import LISTED, some
from calib_ros.values import SAME

Pair: TypeAlias = tuple[str, ...]  # parent and child frame of a link

STATIC = '_static'  # suffix of the topic of static links


class Route(NamedTuple):
    """T_parent_child as `before` times the moving link, or its inverse, times `after`."""

    link: Pair
    inverse: bool
    before: FloatArray
    after: FloatArray


@dataclass
class LinkCount:
    """Count of a moving link, with its first and last stamp."""

    count: int
    first_ns: int
    last_ns: int

    @property
    def rate(self) -> float:
        """Return the mean rate [Hz] by the stamps; 0 if unknown."""
        span = 1e-9 * (self.last_ns - self.first_ns)
        return (self.count - 1) / span if span > 0.0 else 0.0


class Links:
    """The links between frames, and the measurements of sources from them.

    Static links have the topic of moving ones with the suffix _static.
    """

    def __init__(self, topic: str, sources: Sequence[Source] = (), kind: str = TRANSFORMS) -> None:
        self.topic = topic
        self.kind = kind
        self.sources = tuple(sources)
        self._fixed: dict[Pair, FloatArray] = {}
        self._moving: dict[Pair, LinkCount] = {}
        self._changed: set[Pair] = set()
        self._routes: dict[Source, Route | str] = dict.fromkeys(sources, '')
        self._parents = defaultdict[str, list[Pair]](list)  # links by child frame
        self._known = False  # whether the routes are up to date
        self.layouts: Layouts = {}
        self._held: deque[Part] = deque()
        self._let_go: Counter[Pair] = Counter()

    def take(
        self, moving: Sequence[Part], still: Sequence[Part] = ()
    ) -> tuple[list[Part], Counter[str]]:
        """Return the measurements of sources in transforms, and why some cannot be used.

        Frames named anywhere among them are known for all. Measurements wait while the links
        between their frames are unknown.
        """
        for each in still:
            self._fix(each)
        for each in moving:
            self._move(each)
        open_before = {source for source, route in self._routes.items() if route == ''}
        self._update()
        first, faults = min(int(each.places[0]) for each in (*moving, *still)), Counter[str]()
        found = [
            self._measured(s, route, waited)._replace(places=np.full(len(waited.places), first))
            for waited in self._held
            for s, route in self._routes_of(waited.strings)
            if s in open_before
        ]
        is_open = '' in self._routes.values()  # frames of a source are not linked yet
        for part in moving:
            measured = self._routes_of(part.strings)
            if not (is_open or measured):
                continue
            good, causes = usable(part)
            read = part.rows(good)
            faults += Counter({cause: n * len(measured) for cause, n in causes.items()})
            self._held.append(read)
            found += [self._measured(s, route, read) for s, route in measured]
        if not is_open:
            lost_count = sum(n * len(self._routes_of(link)) for link, n in self._let_go.items())
            faults += Counter({Lost('buffer full before their frames were linked'): lost_count})
            self._let_go.clear()
            self._held.clear()
        while sum(len(waiting.places) for waiting in self._held) > Settings.pose_buffer:
            lost = self._held.popleft()
            self._let_go[lost.strings] += len(lost.places)
        return found, faults

    def _fix(self, come: Part) -> None:
        link = come.strings
        good, _ = usable(come._replace(stamps=np.ones_like(come.stamps)))  # they have none
        for numbers in come.numbers[good]:
            matrix = se3.transform(se3.from_quat(numbers[3:]), numbers[:3])
            before = self._fixed.setdefault(link, matrix)
            if not np.allclose(before, matrix, rtol=0.0, atol=SAME):
                self._changed.add(link)
            self._known = False

    def _move(self, come: Part) -> None:
        link, first_ns, last_ns = come.strings, int(come.stamps[0]), int(come.stamps[-1])
        if link not in self._moving:
            if len(self._moving) == MOST_ENTRIES:  # a tracker may number its markers without end
                self._update()
                for each in [*self._moving][: MOST_ENTRIES // 2]:
                    if not self._routes_of(each):
                        del self._moving[each]
            self._moving[link] = LinkCount(0, first_ns, last_ns)
            self._known = False
        seen = self._moving[link]
        seen.count += len(come.places)
        seen.first_ns, seen.last_ns = min(seen.first_ns, first_ns), max(seen.last_ns, last_ns)

    def problems(self) -> list[str]:
        """Return why sources measure nothing, with what to use instead."""
        if not (self._fixed or self._moving):
            return []
        self._update()
        unlinked = 'nothing links frame "{0.child}" to "{0.parent}"'
        return [
            f'{route or unlinked.format(source)} on {self.topic}; {self}'
            for source, route in self._routes.items()
            if not isinstance(route, Route)
        ]

    def __str__(self) -> str:
        if not self._moving:
            return f'nothing moves on {self.topic}'
        self._update()
        # links of an arm have moving ones above or below, others stand alone
        above = {parent: self._ancestors(parent)[0] for parent, _ in self._moving}
        parents = {frame for frames in above.values() for frame in frames}
        alone = {
            (parent, child)
            for parent, child in self._moving
            if child not in parents
            and not any(
                pair in self._moving for each in above[parent] for pair in self._parents[each]
            )
        }
        order = sorted(self._moving, key=lambda link: (link not in alone, link))
        listed = [
            f'{parent} to {child} at {self._moving[parent, child].rate:.0f} Hz'
            for parent, child in order
        ]
        words = f'what moves on {self.topic}: {", ".join(some(listed, LISTED))}'
        parent, child = order[0]
        if not alone:
            return f'{words}; they hang on one another, as the joints of a robot do'
        kind = '' if self.kind == TRANSFORMS else f'type={short_type(self.kind)} '
        pair = f'parent={shlex.quote(parent)} child={shlex.quote(child)}'
        line = f'{self.topic} {kind}{pair}'
        quoted = f'"{line}"' if '"' not in line else shlex.quote(line)
        return f'{words}; name what a device measures in sources (--sources), such as {quoted}'

    # Details

    def _routes_of(self, link: Pair) -> list[tuple[Source, Route]]:
        routes = self._routes.items()
        return [(s, r) for s, r in routes if isinstance(r, Route) and r.link == link]

    def _update(self) -> None:
        if not self._known:
            self._parents.clear()
            for link in sorted({*self._fixed, *self._moving}):
                self._parents[link[1]].append(link)
            self._routes = {source: self._route(source) for source in self.sources}
            self._known = True

    def _route(self, source: Source) -> Route | str:
        """Return how a source is measured; else why not, empty if it may be later."""
        path = self._path(source.parent, source.child)
        if isinstance(path, str):
            return path
        links = [link for link, _ in path]
        name = f'from {source.parent} to {source.child}'
        for link in links:
            if link in self._moving and link in self._fixed:
                both = f'{self.topic} and {self.topic}{STATIC}'
                return f'{" to ".join(link)} comes on both {both}, one is needed'
            if link in self._changed:
                return f'{" to ".join(link)} has changed on {self.topic}{STATIC}: measure again'
        moving = [k for k, link in enumerate(links) if link in self._moving]
        if not moving:
            return f'nothing moves {name}'
        if len(moving) > 1:
            names = ', '.join(' to '.join(links[k]) for k in moving)
            return (
                f'{len(moving)} links move {name} ({names}), and only one may: name frames '
                'between which a device measures, not joints of the robot'
            )
        (k,) = moving
        return Route(*path[k], self._composed(path[:k]), self._composed(path[k + 1 :]))

    def _path(self, parent: str, child: str) -> list[tuple[Pair, bool]] | str:
        for link, inverse in (((parent, child), False), ((child, parent), True)):
            if link in self._moving:  # a direct measurement takes precedence
                return [(link, inverse)]
        first, ambiguous = self._ancestors(child)
        second, also = self._ancestors(parent)
        common = next((frame for frame in first if frame in second), None)
        if common is None:
            return ambiguous or also
        down = [(self._parents[frame][0], False) for frame in first[: first.index(common)]]
        up = [(self._parents[frame][0], True) for frame in second[: second.index(common)]]
        return [*up, *reversed(down)]

    def _ancestors(self, frame: str) -> tuple[list[str], str]:
        """Return a frame and its ancestors, and what is wrong with the last one, if anything."""
        frames = [frame]
        while links := self._parents[frames[-1]]:
            if len(links) > 1:
                parents = ' and '.join(parent for parent, _ in links)
                several = f'frame "{frames[-1]}" has several parents, {parents}'
                return frames, f'{several}: what is measured needs a frame name of its own'
            if links[0][0] in frames:
                return frames, f'frame "{frames[-1]}" is above itself'
            frames.append(links[0][0])
        return frames, ''

    def _composed(self, path: Sequence[tuple[Pair, bool]]) -> FloatArray:
        matrix = np.eye(4)
        for link, inverse in path:
            matrix = matrix @ (se3.invert(self._fixed[link]) if inverse else self._fixed[link])
        return matrix

    def _measured(self, source: Source, route: Route, found: Part) -> Part:
        numbers = found.numbers
        if route.inverse or route.link != (source.parent, source.child):
            links = se3.transform(se3.from_quat(numbers[:, 3:]), numbers[:, :3])
            poses = route.before @ (se3.invert(links) if route.inverse else links) @ route.after
            numbers = np.hstack([poses[:, :3, 3], se3.to_quat(poses[:, :3, :3])])
        frames = source.parent, source.child
        return found._replace(source=source, strings=frames, numbers=numbers)
