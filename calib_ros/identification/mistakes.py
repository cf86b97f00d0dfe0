# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The usual mistakes, tried out: units, conventions, joints, the wrong arm. Never corrected.

If the nominal arm misses the measurements by more than faulty arms do, each suspected mistake is
undone in some samples or in the chain, and base and tool are refitted in closed form (`start.py`).
The best few are refined by least squares. A mistake is named if undoing it reduces the typical
error below NEARER times the original and to a level that faulty arms have; mistakes that explain
nearly as much are named with it. If none does, the positions are tried without the orientations,
then several mistakes at once.

The typical error is the median over the samples of the distance and the angle times LEVER, in
units of the spread of the positions. Mistakes without effect cannot be detected: the zero of the
first joint is a rotation of the base, that of the last joint one of the tool.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from calib_ros.identification.identifiability import excited
from calib_ros.identification.leastsquares import System, factor_of, minimise
from calib_ros.identification.levels import ALIKE, CONFIDENT, MOST_OUTLIERS, NEARER
from calib_ros.identification.lost_rows import lost
from calib_ros.identification.observations import Observations
from calib_ros.identification.problem import Problem
from calib_ros.identification.reasons import Reason, Rule
from calib_ros.identification.resection import board_poses
from calib_ros.identification.samples import Samples
from calib_ros.identification.start import closed_forms
from calib_ros.identification.suspects import ORIENTATIONS, Sets, Suspect, suspects
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.inverse import LEVER
from calib_ros.kinematics.lens import require_lens
from calib_ros.kinematics.parameter import parameters_of
from calib_ros.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from calib_ros.identification.identification import Identification

POLISHED = 6
"""Suspects that are polished (benchmarks/mistakes.py)."""
MOST_AT_ONCE = 4
"""Mistakes made at once that are looked for (benchmarks/mistakes.py)."""


@dataclass(frozen=True, eq=False)
class Explained:
    """What explains the measurements, and their typical errors [m] as given and so."""

    suspects: tuple[Suspect, ...]
    given: float
    so: float

    @property
    def alone(self) -> bool:
        """Tell whether it is enough to refuse a result that nothing else refuses."""
        return not any(each.chain or each.what == ORIENTATIONS.what for each in self.suspects)

    def __str__(self) -> str:
        """Return the mistake and what to do."""
        whats = [f'{each.what}: {each.remedy}' for each in self.suspects]
        return (
            f'{" -- or ".join(whats)} (typical error then {1e3 * self.so:.2f} mm, as given '
            f'{1e3 * self.given:.4g} mm)'
        )


def remarked(problem: Problem, result: Identification) -> Identification:
    """Return the result with the mistake that explains its errors, if there are such.

    It stands first among the refusals, to which measurements that are not what they should be
    belong; another arm, and orientations that do not fit, are a remark where the result is not
    refused.
    """
    if not _suspicious(problem, result):
        return result
    found = explained(problem)
    if found is None:
        return result
    if result.refusals or found.alone:
        return replace(result, refusals=(Reason(Rule.MISTAKE, str(found)), *result.refusals))
    return replace(result, remarks=(str(found), *result.remarks))


def _suspicious(problem: Problem, result: Identification) -> bool:
    """Tell whether errors, before or after, are larger than those of faulty arms.

    Couplings may explain most of what is left, however small, and a fit without end anything.
    """
    if not result.converged or (not result.refusals and result.coupled):
        return True
    judged = result.validation or result.fitted
    for each in (judged.before, judged.after, result.fitted.before):
        turns = each.orientation[~np.isnan(each.orientation[:, 0])]
        if _rms(each.position) > problem.largest_error or _rms(turns) > problem.largest_angle:
            return True
    if judged.outliers > MOST_OUTLIERS * len(judged.judged):
        return True
    limits = problem.largest_length, problem.largest_angle
    return any(each.beyond(*limits) for each in result.parameters)


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt((vectors**2).sum() / max(len(vectors), 1)))


def explained(problem: Problem) -> Explained | None:
    """Return what explains the measurements much better than what was given, if anything does."""
    sets = tuple(e for e in problem.sets if e.distances is None)
    of_images = any(each.pixels is not None for each in sets)
    if of_images:
        sets = tuple(_as_poses(problem, e) for e in sets if e.pixels is not None)
    if not sets or max(map(len, sets)) < 6:
        return None  # base and tool alone explain nearly all of them
    if not any(each.socket for each in sets):
        sets = (max(sets, key=len),)
    chain = replace(
        problem.chain, base=_known(problem.chain.base), tool=_known(problem.chain.tool)
    )
    few = tuple(map(_few, sets))
    given = _tried(chain, few)
    if given is None:
        return None
    found = (
        _named(problem, chain, sets, few, given)
        or _of_a_lost_row(problem, chain, sets, given)
        or _by_places(problem, chain, sets, given)
        or _several(problem, chain, few, given)
    )
    if found is None or not problem.of_messages:
        return found
    return replace(found, suspects=tuple(replace(e, remedy=e.published) for e in found.suspects))


def _named(
    problem: Problem, chain: Chain, sets: Sets, few: Sets, given: _Trial
) -> Explained | None:
    """Return the mistakes that explain nearly the most, up to three, if they explain enough."""
    of_images = any(each.pixels is not None for each in problem.sets)
    rough = []
    for k, each in enumerate(suspects(chain, few, of_images)):
        whole = [_moved(problem, one, each.rows) for one in sets] if each.rows else few
        found = _tried(each.chain or chain, tuple(map(each.change, map(_few, whole))))
        if found is not None and found.share < given.share:
            rough.append((found.share, k, each, found))
    largest = problem.largest_error + LEVER * problem.largest_angle / 3.0
    tried = []
    for _, k, each, found in sorted(rough, key=lambda one: one[:2])[:POLISHED]:
        so = _polished(problem, found)
        if so.error <= largest:  # an arm in mm fits places in mm, and is off by metres
            tried.append((so.share, k, each, so))
    if not tried:
        return None
    tried.sort(key=lambda one: one[:2])
    best = tried[0][3]
    given = min(given, _polished(problem, given), key=lambda one: one.share)
    if best.error > NEARER * given.error:
        return None
    if best.share > NEARER * min(given.share, 1.0):
        return None
    named = [each for share, _, each, _ in tried if share <= ALIKE * best.share]
    lowest = min(each.rank for each in named)
    named = [each for each in named if each.rank == lowest]
    named += [e for share, _, e, _ in tried if ALIKE * best.share < share <= best.share / NEARER]
    unlike = {(each.what, each.remedy): each for each in named}
    return Explained(tuple(unlike.values())[:3], given.error, best.error)


def _of_a_lost_row(problem: Problem, chain: Chain, sets: Sets, given: _Trial) -> Explained | None:
    """Return that a row is missing in one of two tables side by side, if that explains all."""
    if problem.of_messages or len(sets) > 1 or sets[0].socket or sets[0].pixels is not None:
        return None

    def framed(part: Observations) -> Chain | None:
        found = _tried(chain, (_few(part),))
        return None if found is None else _polished(problem, found).chain

    largest = problem.largest_error + LEVER * problem.largest_angle / 3.0
    found = lost(_moved(problem, sets[0], 0), framed, _errors, largest)
    if found is None or found.error > NEARER * given.error:
        return None
    remedy = 'is a row missing, or there twice, in one of two tables? Mend that'
    return Explained((Suspect(found.what, remedy, lambda e: e),), given.error, found.error)


def _by_places(problem: Problem, chain: Chain, sets: Sets, given: _Trial) -> Explained | None:
    """Return that the orientations are wrong, if the arm, or a mistake, explains the positions."""
    of_images = any(each.pixels is not None for each in problem.sets)
    if of_images or not all(e.oriented.all() and not (e.socket or e.inverse) for e in sets):
        return None
    alone = tuple(replace(each, oriented=np.zeros(len(each), dtype=bool)) for each in sets)
    few = tuple(map(_few, alone))
    start = _tried(chain, few)
    if start is None:
        return None
    so = _polished(problem, start)
    given = min(given, _polished(problem, given), key=lambda one: one.share)
    if so.error <= min(problem.largest_error, NEARER * given.error):
        known = so.error + LEVER * problem.sigma_orientation
        enough = known < NEARER * given.error
        return Explained((ORIENTATIONS,), given.error, so.error) if enough else None
    found = _named(problem, chain, alone, few, start)
    if found is None or len(found.suspects) > 1:
        return None
    what = f'{found.suspects[0].what}, and the orientations do not fit either'
    return replace(found, suspects=(replace(found.suspects[0], what=what),))


def _several(problem: Problem, chain: Chain, few: Sets, given: _Trial) -> Explained | None:
    """Return mistakes that were made at once, each of which explains a part of the errors.

    The best few are kept and another one is added to each, until the arm explains the rest, or
    one more is no better. One alone may be no better: two can hide each other.
    """
    given = min(given, _polished(problem, given), key=lambda one: one.share)
    if given.error <= problem.largest_error:
        return None
    of_images = any(each.pixels is not None for each in problem.sets)
    options = [each for each in suspects(chain, few, of_images) if each.part]
    largest = min(
        problem.largest_error + LEVER * problem.largest_angle / 3.0, NEARER * given.error
    )
    share, least = NEARER * min(given.share, 1.0), given.share
    kept: list[tuple[Suspect, ...]] = [()]
    for _ in range(MOST_AT_ONCE):
        found: dict[float, tuple[_Trial, tuple[Suspect, ...]]] = {}
        for some in kept:
            for each in options:
                if each.part not in {one.part for one in some}:
                    more = tuple(sorted((*some, each), key=lambda one: one.part != 'measured'))
                    trial = _tried(chain, _undone(more, few))
                    if trial is not None:  # others may be the same in other words
                        found.setdefault(round(trial.share, 6), (trial, more))
        best = [found[key] for key in sorted(found)[:POLISHED]]
        if not best or (len(best[0][1]) > 1 and best[0][0].share > CONFIDENT * least):
            return None
        least = best[0][0].share
        so = _polished(problem, best[0][0])
        kept = [some for _, some in best]
        if len(kept[0]) > 1 and so.error <= largest and so.share <= share:
            return Explained((_together(kept[0]),), given.error, so.error)
    return None


def _undone(mistakes: Sequence[Suspect], sets: Sets) -> Sets:
    for each in mistakes:
        sets = tuple(map(each.change, sets))
    return sets


def _together(mistakes: Sequence[Suspect]) -> Suspect:
    """Return several mistakes as one."""
    remedies = [
        (each.what, each.remedy if each.part == 'measured' else each.published, each.published)
        for each in mistakes
    ]
    return replace(
        mistakes[0],
        what='several mistakes at once',
        remedy='; '.join(f'{what} ({remedy})' for what, remedy, _ in remedies),
        published='; '.join(f'{what} ({published})' for what, _, published in remedies),
    )


def _known(frame: Frame | None) -> Frame | None:
    return frame if frame is not None and frame.fixed else None


def _as_poses(problem: Problem, each: Observations) -> Observations:
    """Return what was measured, boards in images by their poses."""
    if each.pixels is None:
        return each
    return board_poses(each, require_lens(problem.chain.frame(each.camera).lens, each.camera))


def _few(observations: Observations) -> Observations:
    return observations.spread()


@dataclass(frozen=True, eq=False)
class _Trial:
    """A chain with its frames for some samples, and their typical error [m].

    `share` is the error in units of the spread of the positions, of the flange or measured, which
    is less: with metres taken for millimetres, or radians for degrees, every error is small.
    """

    chain: Chain
    sets: Sets
    error: float
    share: float


def _tried(chain: Chain, sets: Sets) -> _Trial | None:
    """Return the chain with its frames for some samples in closed form, set by set."""
    spreads = []
    for each in sets:
        best: tuple[float, Chain] | None = None
        alone = (replace(each, base='base', tool='tool'),)
        for start in closed_forms(chain, alone[0]):
            error = _error(start, alone)
            if np.isfinite(error) and (best is None or error < best[0]):
                best = error, start
        if best is None:
            return None
        bare = replace(best[1], base=None, tool=None).forward(each.joints)[:, :3, 3]
        seen = bare if each.socket else each.positions  # in sockets there is no measured place
        spreads.append(min(float(np.sqrt(one.var(axis=0).sum())) for one in (bare, seen)))
        chain = chain.with_frame(each.base, best[1].frame('base'))
        chain = chain.with_frame(each.tool, best[1].frame('tool'))
    return _trial(chain, sets, float(np.median(spreads)))


def _trial(chain: Chain, sets: Sets, spread: float) -> _Trial:
    error = _error(chain, sets)
    return _Trial(chain, sets, error, error / max(spread, 1e-9))


def _polished(problem: Problem, trial: _Trial) -> _Trial:
    """Return a trial with its frames by least squares."""
    chain, sets = trial.chain, trial.sets
    samples = [Samples(each, problem.sigma_position, problem.sigma_orientation) for each in sets]
    system = System(tuple(samples))
    frames = dict.fromkeys(name for each in sets for name in (each.base, each.tool))
    sockets = {each.base for each in sets if each.socket}
    names = [
        name
        for frame in frames
        if not chain.frame(frame).fixed
        for name in parameters_of(frame)
        if name.is_length or frame not in sockets
    ]
    known = excited(factor_of(chain, names, system), names)
    fitted = minimise(chain, known, system, tolerance=1e-2, iterations=12).chain
    spread = trial.error / trial.share if trial.share > 0.0 else np.inf
    return min(trial, _trial(fitted, sets, spread), key=lambda one: one.error)


def _error(chain: Chain, sets: Sets) -> float:
    """Return the median of the samples' errors [m]."""
    return float(np.median(np.concatenate([_errors(chain, each) for each in sets])))


def _errors(chain: Chain, each: Observations) -> FloatArray:
    """Return the errors (N,) [m] of samples."""
    found = chain.forward(each.joints, base=each.base, tool=each.tool)
    away = np.linalg.norm(each.positions - found[:, :3, 3], axis=1)
    if each.oriented.any():
        turns = se3.angles_between(found[:, :3, :3], each.rotations)
        away = away + LEVER * np.where(each.oriented, turns, 0.0)
    return np.asarray(away)


def _moved(problem: Problem, each: Observations, rows: int) -> Observations:
    """Return each measurement with the joint values so many rows below, held-out rows included."""
    same = [e for e in problem.judging if (e.base, e.tool) == (each.base, each.tool)]
    same = [_as_poses(problem, e) for e in same]
    parts = [replace(e, covariance=None) for e in (each, *same) if e.distances is None]
    order = np.argsort(np.concatenate([e.stamps_ns for e in parts]), kind='stable')
    here = slice(max(0, -rows), len(order) - max(0, rows))
    there = slice(max(0, rows), len(order) - max(0, -rows))
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(e, name) for e in parts])[
            order[there if name == 'joints' else here]
        ]
        for name in ('stamps_ns', 'joints', 'positions', 'rotations', 'oriented')
    }
    return Observations(**joined, base=each.base, tool=each.tool, socket=each.socket)
