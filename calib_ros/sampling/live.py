# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The estimate during sampling, from a growing list of samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from calib_ros.errors import CalibrationError
from calib_ros.estimation.configurations import configurations, count_distinct
from calib_ros.estimation.fitting import SOME
from calib_ros.estimation.identifiability import structurally_independent
from calib_ros.estimation.problem import Problem
from calib_ros.kinematics.parameter import IN_A_FRAME
from calib_ros.sampling.estimate import Estimate, Update
from calib_ros.sampling.live_fit import live_fit
from calib_ros.sampling.sample import Frames, Sample

START = IN_A_FRAME
"""Configurations needed to find two frames: three coordinates each for two unknowns."""


class LiveEstimate:
    """The estimate from a growing list of samples.

    One thread may update it while others read what is `known`.
    """

    def __init__(self, problem_of: Callable[[Sequence[Sample]], Problem]) -> None:
        self._problem_of = problem_of
        self._seen: list[Sample] = []
        self._structure: tuple[object, ...] = ()
        self._names: tuple[str, ...] = ()
        self.known = Update()  # by the last update

    def update(self, samples: Sequence[Sample]) -> Estimate | None:
        """Return the estimate from these samples, or None while there are too few."""
        if self._seen != list(samples):
            self.known = self._updated([each for each in samples if not each.validation])
            self._seen = list(samples)
        return self.known.estimate

    def _updated(self, samples: Sequence[Sample]) -> Update:
        some = _spread(samples)
        if count_distinct(configurations(np.array([each.joints for each in some]))) < START:
            return Update()
        try:
            problem = self._problem_of(some)
        except CalibrationError as err:
            return Update(refused=str(err))
        try:
            return live_fit(problem, self._independent(problem), some, len(samples))
        except (CalibrationError, np.linalg.LinAlgError):
            return Update()

    def _independent(self, problem: Problem) -> tuple[str, ...]:
        """Return what many poses would determine, found anew only if it may be something else."""
        ways = ((s.socket, s.plane, s.seen, s.width, s.moving) for s in problem.sets)
        ends = ((each.base, each.tool) for each in problem.sets)
        structure = problem.chain, problem.free, *ends, *ways
        if structure != self._structure:
            self._names = structurally_independent(problem.model, problem.free, problem.sets)
            self._structure = structure
        return self._names


def _spread(samples: Sequence[Sample]) -> list[Sample]:
    """Return about SOME samples, evenly from those between each pair of frames."""
    frames = Frames()
    groups: dict[tuple[str, str], list[int]] = {}
    for k, sample in enumerate(samples):
        groups.setdefault(frames.of(sample), []).append(k)
    chosen: set[int] = set()
    for members in groups.values():
        count = min(len(members), 1 + SOME // len(groups))
        chosen |= {members[k] for k in np.linspace(0, len(members) - 1, count).astype(int)}
    return [samples[k] for k in sorted(chosen)]
