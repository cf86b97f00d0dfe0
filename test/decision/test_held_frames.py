# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames that the chain file holds in wrong places."""

from dataclasses import replace

import fits
import numpy as np
import pytest
from fits import NOISE, SCARA, SIGMAS, UR10E

from calib_ros import Problem, identify
from calib_ros.apply.simulation import measure
from calib_ros.decision.reasons import Rule
from calib_ros.decision.steps import find_step
from calib_ros.estimation import fitting
from calib_ros.kinematics import se3

unsearched = pytest.mark.usefixtures('unsearched')


@unsearched
def test_a_base_held_in_a_wrong_place_is_no_step(rng):
    true = fits.arm(rng)
    seen = measure(true, UR10E.random_joints(60, rng), rng, *NOISE)
    held = true.base.matrix.copy()
    held[:3, 3] += [0.003, 0.0, 0.004]
    chain = replace(UR10E, base=replace(true.base, matrix=held, fixed=True))
    result = identify(Problem(chain, seen, **SIGMAS))
    assert result.refusals[0].rule is Rule.MISTAKE
    assert 'the base held by the chain file is off by' in result.refusals[0]


@unsearched
@pytest.mark.parametrize(('held', 'in_turn'), [((0, 1, 2, 3), False), ((1, 3), True)])
def test_bases_of_sessions_held_in_wrong_places_are_no_drift(held, in_turn):
    """One after another they follow slow waves: a correction 1 mm off was accepted."""
    rng = np.random.default_rng(1)
    true, q = fits.arm(rng), UR10E.random_joints(100, rng)
    seen = measure(true, q.mean(axis=0) + 0.2 * (q - q.mean(axis=0)), rng, *NOISE)
    which = np.arange(100) % 4 if in_turn else np.arange(100) // 25
    sets = [replace(seen.select(which == k), base=f'base_{k}') for k in range(4)]
    chain = replace(UR10E, base=None, tool=None)
    for k in held:
        wrong = true.base.matrix.copy()
        wrong[:3, 3] += rng.normal(scale=3e-4, size=3)
        chain = chain.with_frame(f'base_{k}', replace(true.base, matrix=wrong, fixed=True))
    refused = identify(Problem(chain, sets[0], more=sets[1:], **SIGMAS)).refusals[0]
    bases = ', '.join(f'base_{k}' for k in held)
    assert refused.startswith(f'the {bases} held by the chain file are off by')


@unsearched
def test_a_held_base_is_off_by_what_shows_not_along_what_the_tool_makes_up_for(rng):
    """Axes of a SCARA are parallel but for errors: some mm were told as 440, mostly of height."""
    first, elbow, quill, spindle = SCARA.joints
    nominal = replace(SCARA, joints=(first, elbow, spindle, quill))
    true = fits.arm(rng, chain=nominal)
    seen = measure(true, nominal.random_joints(60, rng), rng, *NOISE)
    held = true.base.matrix.copy()
    held[:3, :3] @= se3.exp_rotation(np.array([[2e-3, -2e-3, 0.0]]))[0]
    chain = replace(nominal, base=replace(true.base, matrix=held, fixed=True))
    step = find_step(fitting.fit(Problem(chain, seen, **SIGMAS)))
    assert step.held
    assert step.size < 0.01


def test_a_held_base_of_the_last_session_did_not_move_within_it():
    """The tool makes up for two directions of its place: six of a move explain a little more."""
    rng = np.random.default_rng(22)
    true = fits.arm(rng, chain=SCARA)
    seen = measure(true, SCARA.random_joints(72, rng), rng, *NOISE)
    wrong = true.base.matrix.copy()
    wrong[:3, 3] += [3e-4, 0.0, 4e-4]
    held = replace(true.base, matrix=wrong, fixed=True)
    names = 'base_0', 'base_1', 'base_2, left'
    chain = replace(SCARA, base=None, tool=None).with_frame(names[2], held)
    parts = [seen.select(np.arange(72) // 24 == k) for k in range(3)]
    sets = [replace(part, base=name) for part, name in zip(parts, names, strict=True)]
    step = find_step(fitting.fit(Problem(chain, sets[0], more=sets[1:], **SIGMAS)))
    assert step.held
    assert step.owners == names[2:]
    assert 'left held by the chain file is off by' in str(step)


@pytest.mark.parametrize(('kind', 'count'), [('base', 3), ('tool', 1)])
def test_frames_by_name_held_centimetres_off_are_all_named(kind, count):
    """Another robot was named, which fits no better."""
    rng = np.random.default_rng(0)
    true, chain, sets = fits.arm(rng), replace(UR10E, base=None, tool=None), []
    names = [f'{kind}_{k}' for k in range(3)]
    for k, name in enumerate(names):
        seen = measure(true, UR10E.random_joints(24, rng), rng, *NOISE)
        sets.append(replace(seen.at((24 * k + np.arange(24)) * 10**9), **{kind: name}))
        wrong = true.frame(kind).matrix.copy()
        wrong[:3, 3] += [0.0, 0.03, 0.04]
        if k < count:
            chain = chain.with_frame(name, replace(true.frame(kind), matrix=wrong, fixed=True))
    result = identify(Problem(chain, sets[0], more=sets[1:], **SIGMAS))
    told = 'in the measurements with {0} alone, the chain file gives a wrong {0} (fixed: true): '
    if count > 1:
        told = f'the {", ".join(names)} held by the chain file are off by 50 mm: '
    assert result.refusals[0].startswith(told.format(names[0]))


@pytest.mark.parametrize(('far', 'refused'), [(0.02, True), (0.0, False)])
def test_a_tool_held_far_off_along_the_last_axis_is_refused(rng, far, refused):
    """The last row of the table made up for it: accepted with d 20 mm off, and a remark."""
    true = fits.arm(rng)
    seen = measure(true, UR10E.random_joints(60, rng), rng, *NOISE)
    wrong = true.tool.matrix.copy()
    wrong[2, 3] += far
    held = replace(true.tool, matrix=wrong, fixed=True)
    result = identify(Problem(replace(UR10E, tool=held), seen, **SIGMAS))
    assert ('gives a wrong tool' in ''.join(result.refusals)) == refused
    assert result.accepted != refused
