# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros plan`: which poses to measure."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from calib_ros.apply import planning
from calib_ros.apply.candidates import Visibility, draw_candidates
from calib_ros.apply.choice import Choice, fewest
from calib_ros.apply.design import ASSUMED_TOOL, Design
from calib_ros.apply.iso_9283 import iso_9283_poses
from calib_ros.apply.planning import Plan
from calib_ros.apply.simulation import measure
from calib_ros.atomic import write_together
from calib_ros.cli import checks, common, inputs
from calib_ros.cli.screen import Screen
from calib_ros.errors import InputError
from calib_ros.estimation.problem import Problem
from calib_ros.files.programs import joints_csv, read_joints
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.progress import Notify
from calib_ros.report.advice import ENOUGH
from calib_ros.report.plan import VISIT, accuracy_in_words, outlook, plan_report

TESTS = 'P1 to P5 of ISO 9283 in a cube of {:.3f} m, in {}; collisions are not checked'
NOISE = 'device noise: {:g} mm in each direction (--sigma-position)'
WITH_TURNS = 'orientations count as measured too (for a reflector alone: --measured position)'
NOT_OF_TESTS = ('poses', 'accuracy', 'candidates', 'task', 'taken', 'draw', 'criterion', 'apart')
ORIENTED = 'various orientations', 'one orientation'


def _run(options: argparse.Namespace, screen: Screen) -> int:
    _check(options)
    chain = load_chain(options.chain)
    rng = np.random.default_rng(options.seed)
    anywhere = chain.random_joints(1, np.random.default_rng(0))
    imagined = measure(chain, anywhere, rng, oriented=options.measured == 'pose')
    settings = common.settings_of(options)
    design = Design.of(Problem(chain, imagined, **settings.for_problem()))
    box = None if options.box is None else np.reshape(options.box, (2, 3))
    tracker = None if options.tracker is None else np.array(options.tracker)
    axis, cone = tuple(options.axis), np.radians(options.cone)
    visibility = Visibility(box, tracker, axis, cone, options.world)
    with screen.work('choosing poses') as work:
        if options.iso9283:
            tests = iso_9283_poses(design, rng, visibility)
            remarks = [TESTS.format(tests.edge, ORIENTED[tests.oriented])]
            joints, plan = tests.joints, None
        else:
            joints, remarks, plan = _measurement(options, design, visibility, rng, work)
    table = [] if plan is None else accuracy_in_words(plan)
    if plan is not None:
        remarks.append(NOISE.format(1e3 * settings.sigma_position))
        remarks += [WITH_TURNS] if options.measured == 'pose' else []
    if chain.tool is None:
        place = ' '.join(f'{x:g}' for x in ASSUMED_TOOL)
        remarks.append(f'the tool is unknown: the target is assumed at {place} m from the flange')
    ranges: dict[str, list[str]] = {}
    for joint in chain.joints if options.candidates is None else ():
        if None in (joint.lower, joint.upper):
            turns = joint.type == 'revolute'
            lower, upper = np.degrees(joint.range) if turns else joint.range
            planned = f'from {lower:g} to {upper:g} {"degrees" if turns else "m"}'
            ranges.setdefault(planned, []).append(joint.name)
    for planned, names in ranges.items():
        remarks.append(
            f'without limits, planned {planned}: {", ".join(names)}; give the limits in the chain '
            'file (lower, upper)'
        )
    screen.say('\n'.join([*table, *remarks, *([VISIT] if plan is None else [])]))
    if options.out is not None:
        page = _page_beside(options.out)
        origin = inputs.origin_of(options, (options.candidates, options.task, options.taken))
        report = plan_report(design.chain, joints, remarks, origin, plan, options.accuracy)
        pages = inputs.page_of(options, report, screen, page.name)
        beside = {options.out.with_name(name): text for name, text in pages.items()}
        write_together({options.out: joints_csv(joints), **beside}, overwrite=options.force)
        screen.say(f'wrote {options.out}' + (f' and {page}' if pages else ''))
    else:
        screen.bullet('nothing was saved: --out FILE writes the poses and a report')
    return 0


def _measurement(
    options: argparse.Namespace,
    design: Design,
    visibility: Visibility,
    rng: np.random.Generator,
    progress: Notify,
) -> tuple[FloatArray, list[str], Plan]:
    size = len(design.chain.joints)
    if len(options.velocity) not in (1, size):
        raise InputError(f'--velocity: give one value, or {size}, not {len(options.velocity)}')
    if options.taken is not None:
        design = design.after(read_joints(options.taken, design.chain))
    chain = design.chain
    task = read_joints(options.task, chain) if options.task else chain.random_joints(300, rng)
    if options.candidates is None:
        candidates = draw_candidates(design, options.draw, rng, visibility)
    else:
        candidates = read_joints(options.candidates, design.chain)
        candidates = candidates[visibility.sees(design, candidates)]
        if not len(candidates):
            raise InputError(f'the device sees the target at no pose of {options.candidates}')
    choice = {'criterion': options.criterion, 'apart': options.apart, 'progress': progress}
    needed = chosen = None
    if options.accuracy is not None:
        given = Choice(design, candidates, task=task, **choice)
        least = fewest(given, 1e-3 * options.accuracy)
        needed = len(least)
        chosen = least if options.poses in (None, needed) else None
    count = options.poses or needed or ENOUGH
    choice |= {'velocities': np.broadcast_to(options.velocity, size), 'chosen': chosen}
    plan = planning.plan(design, candidates, task, count, **choice)
    remarks = outlook(plan, len(candidates), options.accuracy, needed)
    return plan.joints[plan.visit], remarks, plan


def _check(options: argparse.Namespace) -> None:
    if options.iso9283:
        checks.refuse(options, (*NOT_OF_TESTS, 'velocity'), 'does not apply to --iso9283')
    if options.candidates is not None:
        checks.refuse(options, ('draw',), 'does not apply to --candidates')
    if options.box is None and options.tracker is None:
        checks.refuse(options, ('world',), 'needs --box or --tracker')
    checks.at_least(options, poses=1, draw=1, seed=0, apart=0)
    if options.accuracy is not None and not options.accuracy > 0.0:
        raise InputError(f'--accuracy must be positive, not {options.accuracy}')
    if not all(value > 0.0 for value in options.velocity):
        raise InputError('each --velocity must be positive')
    if options.out is not None:
        checks.refuse_existing(options, options.out, _page_beside(options.out))


def _page_beside(path: Path) -> Path:
    return path.parent / f'{path.stem}.report.html'
