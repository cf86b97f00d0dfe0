# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The content of a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, TypeAlias

import calib_ros
from calib_ros.files.hashes import Input
from calib_ros.report.refusals import Advice
from calib_ros.shown import clipped

State: TypeAlias = Literal['good', 'bad', 'open', 'info']


@dataclass(frozen=True)
class Headline:
    """What a reader sees first: state, words, and the `gain` from before to after."""

    state: State
    heading: str
    text: tuple[str, ...] = ()
    gain: str = ''


@dataclass(frozen=True)
class Section:
    """Text, a plotly figure, a table, or several; `said` also holds without the figure."""

    name: str
    title: str
    text: tuple[str, ...] = ()
    figure: Mapping[str, Any] | None = None
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    height: int = 420
    said: tuple[str, ...] = ()


def section(name: str, title: str, *text: str, **more: Any) -> Section:
    """Return a section with the paragraphs that are not empty."""
    return Section(name, title, tuple(filter(None, text)), **more)


@dataclass(frozen=True)
class Origin:
    """Origin of a result, known only to its caller; empty if not given."""

    inputs: tuple[Input, ...] = ()
    operator: str = ''
    serial: str = ''
    device: str = ''
    settings: str = ''  # configuration to repeat it
    command: str = ''  # command to repeat it, if any
    conditions: str = ''  # temperature, load and the like

    def document(self) -> dict[str, Any]:
        """Return it as plain values, without the settings, which have their own file."""
        return {name: value for name, value in asdict(self).items() if name != 'settings'}


@dataclass(frozen=True)
class Report:
    """Content of the page, in order."""

    kind: str
    robot: str
    verdict: Headline
    advice: tuple[Advice, ...] = ()
    accuracy: Section | None = None
    picture: Section | None = None  # beside the accuracy: a figure or a table
    steps: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    identity: tuple[tuple[str, str], ...] = ()
    explorer: Mapping[str, Any] | None = None
    sections: tuple[Section, ...] = ()
    origin: Origin = Origin()
    software: str = field(default=f'calib_ros {calib_ros.__version__}')

    @property
    def title(self) -> str:
        """Return the name of the robot, with its serial number if known, on one line."""
        return clipped(' '.join(filter(None, (self.robot, self.origin.serial))))

    @property
    def of(self) -> str:
        """Return the name of the first input file."""
        return next((each.name.split('/')[0] for each in self.origin.inputs), '')

    @property
    def shown(self) -> tuple[Section, ...]:
        """Return the sections that may have a figure."""
        return (*filter(None, (self.picture,)), *self.sections)
