# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E, rms
from sessions import seen

from calib_ros import CalibrationSession, Chain, Settings, identify
from calib_ros.apply.simulation import Cell, faulty, random_frame
from calib_ros.kinematics.chain import Joint
from calib_ros.kinematics.se3 import exp_rotation
from calib_ros.sampling import live as live_module, live_fit as fit_module
from calib_ros.sampling.forecast import barely_moved
from calib_ros.sampling.live import START, LiveEstimate


def session(**settings):
    return CalibrationSession(UR10E, Settings(**SIGMAS | settings))


def learned(samples, **settings):
    """Return what a live estimate knows after these samples."""
    live = LiveEstimate(session(**settings).problem_of)
    live.update(samples)
    return live.known


def apart(first, second, rng):
    """Return the RMS distance [m] of what two chains predict."""
    return rms(first, second, UR10E.random_joints(300, rng))


@pytest.mark.parametrize(('oriented', 'seed'), [(True, 1), (False, 2)])
def test_it_is_what_the_identification_finds(oriented, seed):
    rng = np.random.default_rng(seed)
    samples = seen(faulty(UR10E, Cell(), rng), 80, rng, oriented)
    found = learned(samples)
    batch = identify(session().problem_of(samples))
    assert apart(found.estimate.chain, batch.chain, rng) < 0.05 * NOISE[0]
    assert found.estimate.noise == pytest.approx(1.0, abs=0.15)
    assert found.estimate.misfit == pytest.approx(found.estimate.noise * NOISE[0], rel=0.3)
    predicted = np.sqrt(np.mean(batch.predicted_sigma() ** 2))
    assert found.estimate.sigma == pytest.approx(predicted, rel=0.25)
    assert found.suspicious == ()


def test_it_begins_early_and_only_gets_better(rng):
    samples = seen(faulty(UR10E, Cell(), rng), 60, rng)
    said = [learned(samples[:k]).estimate for k in (0, 1, START - 1, START, 10, 20, 40, 60)]
    assert said[:3] == [None] * 3
    sigmas = [each.sigma for each in said[3:]]
    assert sigmas == sorted(sigmas, reverse=True)
    assert sigmas[-1] < 0.2 * sigmas[0]
    more = said[-1].more_for(0.5 * said[-1].sigma)
    assert more == pytest.approx(3 * 60, abs=1)
    assert said[-1].more_for(2.0 * said[-1].sigma) == 0


def test_fewer_rows_than_parameters_have_the_noise_that_is_stated(rng):
    samples = seen(faulty(UR10E, Cell(), rng), 20, rng, oriented=False)
    few, many = (learned(samples[:k]).estimate for k in (9, 10))
    assert (len(few.names), few.noise) == (27, 1.0)
    assert many.noise != 1.0


def test_of_many_samples_some_of_each_pair_of_frames_are_fitted(rng, monkeypatch):
    """They tell of all: how well the arm is known, and how many more are needed."""
    true = faulty(UR10E, Cell(), rng)
    samples = seen(true, 150, rng) + seen(true, 8, rng, start=200, target='other')
    every = learned(samples).estimate
    monkeypatch.setattr(live_module, 'SOME', 80)
    taken = []
    live = LiveEstimate(lambda some: taken.extend(some) or session().problem_of(some))
    some = live.update(samples)
    assert [sum(each.target == target for each in taken) for target in ('', 'other')] == [41, 8]
    assert some.samples == every.samples == 158
    assert some.sigma == pytest.approx(every.sigma, rel=0.2)


@pytest.mark.parametrize(
    ('oriented', 'places'),
    [(False, [0, 3, 8]), (True, list(range(START))), (False, list(range(START)))],
)
def test_gross_errors_are_found(oriented, places, rng):
    """The estimate is that of the good ones alone."""
    samples = seen(faulty(UR10E, Cell(), rng), 50, rng, oriented)
    for k in places:
        way = rng.normal(size=3)
        shift = rng.uniform(5e-3, 50e-3) * way / np.linalg.norm(way)
        samples[k] = replace(samples[k], position=samples[k].position + shift)
    found = learned(samples)
    assert set(found.suspicious) == {samples[k] for k in places}
    good = [each for k, each in enumerate(samples) if k not in places]
    batch = identify(session().problem_of(good))
    assert found.estimate.samples == len(good)
    assert apart(found.estimate.chain, batch.chain, rng) < 0.05 * NOISE[0]


def test_samples_that_early_ones_speak_against_come_back(rng):
    """The target was knocked after twenty samples; forty more, and those of before are wrong."""
    true = faulty(UR10E, Cell(), rng)
    knocked = replace(true, tool=true.tool.moved({'x': 5e-3}))
    samples = seen(true, 20, rng) + seen(knocked, 40, rng, start=20)
    live = LiveEstimate(session().problem_of)
    live.update(samples[:30])
    assert set(live.known.suspicious) == set(samples[20:30])
    estimate = live.update(samples)
    assert set(live.known.suspicious) == set(samples[:20])
    assert apart(estimate.chain, knocked, rng) < 3.0 * estimate.sigma


@pytest.mark.parametrize('turned', [0.0, 0.02])
@pytest.mark.parametrize('given', [0.2, 5.0])
def test_only_samples_far_off_by_the_stated_and_the_actual_noise_are_named(rng, given, turned):
    sigmas = {name: given * sigma for name, sigma in SIGMAS.items()}
    samples = seen(faulty(UR10E, Cell(), rng), 60, rng)
    turn = exp_rotation(np.array([turned, 0.0, 0.0]))
    samples[7] = replace(samples[7], rotation=samples[7].rotation @ turn)
    assert set(learned(samples, **sigmas).suspicious) == ({samples[7]} if turned else set())


@pytest.mark.parametrize('seed', range(3))
def test_hardly_more_rows_than_parameters_accuse_no_sample(seed):
    """The noise is three times what is stated, and a half of the samples fits by chance."""
    rng = np.random.default_rng(seed)
    samples = seen(faulty(UR10E, Cell(), rng), 19, rng, oriented=False)
    given = {name: sigma / 3.0 for name, sigma in SIGMAS.items()}
    assert learned(samples, **given).suspicious == ()


def test_several_devices_and_targets(rng):
    true = faulty(UR10E, Cell(), rng)
    other = replace(true, base=random_frame(rng, 2.0))
    third = replace(true, tool=random_frame(rng, 0.3))
    samples = seen(true, 30, rng)
    samples += seen(other, 20, rng, start=100, device='B')
    samples += seen(third, 20, rng, oriented=False, start=200, target='ball')
    found = learned(samples)
    batch = identify(session().problem_of(samples))
    assert set(found.estimate.chain.frame_names) == {'base', 'tool', 'base_B', 'tool_ball'}
    assert apart(found.estimate.chain, batch.chain, rng) < 0.1 * NOISE[0]
    assert found.suspicious == ()


def test_the_latest_sample_that_does_not_fit_comes_last(rng):
    """It is the one that the status names, whichever device measured it."""
    true = faulty(UR10E, Cell(), rng)
    first, second = seen(true, 30, rng), seen(true, 30, rng, start=100, device='B')
    first[25] = replace(first[25], position=first[25].position + 0.01)
    second[20] = replace(second[20], position=second[20].position + 0.01)
    samples = [each for pair in zip(first, second, strict=True) for each in pair]
    assert learned(samples).suspicious == (second[20], first[25])


def by_wire(samples, unit=1.0):
    """Return what a wire at the tracker's origin measures at the same stops."""
    ends = {'device': 'wire', 'position': None, 'rotation': None}
    return [
        replace(s, stamp_ns=s.stamp_ns + 500, distance=unit * np.linalg.norm(s.position), **ends)
        for s in samples
    ]


def test_a_gross_error_of_a_wire_is_found_as_of_a_tracker(rng):
    samples = seen(faulty(UR10E, Cell(), rng), 40, rng)
    samples += by_wire(samples)
    samples[77] = replace(samples[77], distance=samples[77].distance + 1e-3)
    assert [learned(samples[:k]).estimate.samples for k in (70, 80)] == [70, 79]
    assert learned(samples).suspicious == (samples[77],)


def test_samples_that_make_no_problem_yet_are_told_or_waited_for(rng, monkeypatch):
    samples = seen(faulty(UR10E, Cell(), rng), 20, rng)
    estimate, refused, _ = learned([*samples, *by_wire(samples, 1e3)])
    assert (estimate, 'are they in metres' in refused) == (None, True)
    with monkeypatch.context() as failing:
        failing.setattr(fit_module, 'start_frames', lambda *_: np.linalg.inv(np.zeros((1, 1))))
        assert learned(samples) == (None, '', ())
    assert learned(samples).estimate.samples == 20


@pytest.mark.parametrize('share', [0.0, 0.5, 1.0])
@pytest.mark.parametrize(
    'own', [{'covariance': np.diag(np.repeat(NOISE, 3) ** 2)}, {'spread': NOISE[0]}]
)
def test_what_is_left_is_compared_with_the_scatter_of_each_sample(rng, own, share):
    """With the given sigma where it is not known, here a third of the noise."""
    samples = seen(faulty(UR10E, Cell(), rng), 80, rng)
    for k in rng.permutation(80)[: round(share * 80)]:
        samples[k] = replace(samples[k], **own)
    given = {name: sigma / 3.0 for name, sigma in SIGMAS.items()}
    found = learned(samples, **given).estimate
    assert found.excess == pytest.approx(np.sqrt(9.0 - 8.0 * share), rel=0.15)


def test_held_out_samples_are_not_fitted(rng):
    true = faulty(UR10E, Cell(), rng)
    samples = seen(true, 40, rng)
    alone = learned(samples).estimate
    judges = seen(faulty(UR10E, Cell(), rng), 20, rng, start=100, validation=True)
    mixed = [each for pair in zip(samples, judges * 2, strict=True) for each in pair]
    found = learned(mixed)
    assert apart(found.estimate.chain, alone.chain, rng) < 1e-9
    assert found.estimate.samples == 40
    assert found.suspicious == ()


@pytest.mark.parametrize(('validation', 'spread'), [(True, 1.0), (False, 0.0), (False, 1.0)])
def test_samples_that_tell_nothing_yet_are_no_error(rng, validation, spread):
    """Only judging ones, or always the same place."""
    true = faulty(UR10E, Cell(), rng)
    (one,) = seen(true, 1, rng)
    samples = []
    for k in range(12):
        noise = rng.normal(scale=spread * NOISE[0], size=3)
        samples.append(replace(one, stamp_ns=k + 1, position=one.position + noise))
    samples = [replace(each, validation=validation) for each in samples]
    assert learned(samples) == (None, '', ())
    estimate, _, suspicious = learned([*samples, *seen(true, 30, rng, start=50)])
    assert apart(estimate.chain, true, rng) < 4.0 * estimate.sigma
    assert estimate.sigma < NOISE[0]
    assert suspicious == ()


def test_nothing_is_computed_again_without_a_new_sample(rng):
    samples = seen(faulty(UR10E, Cell(), rng), 20, rng)
    asked = []
    live = LiveEstimate(lambda some: asked.append(len(some)) or session().problem_of(some))
    for count in (20, 20, 19, 20):
        live.update(samples[:count])
    assert asked == [20, 19, 20]


def test_another_kind_of_samples_is_another_structure(rng):
    """What many poses would determine is found anew for them alone."""
    true = faulty(UR10E, Cell(), rng)
    points, poses = seen(true, 12, rng, oriented=False), seen(true, 12, rng, start=20)
    every, live = points + poses, LiveEstimate(session().problem_of)
    counts = [len(live.update(every[:k]).names) for k in (10, 12, 13, 24, 10)]
    assert counts == [27, 27, 30, 30, 27]


def test_joints_that_hardly_moved_are_named():
    held = Joint('held', lower=0.0, upper=0.0)
    chain = Chain('arm', 'standard', (Joint('a'), Joint('b'), Joint('c', 'prismatic'), held))
    joints = np.array([[0.0, 0.0, 0.0, 0.0], [1.0, 0.3, 0.02, 0.0], [-1.0, 0.1, 0.1, 0.0]])
    assert barely_moved(chain, joints) == ('b',)
    assert barely_moved(chain, joints[:1]) == ('a', 'b', 'c')


def test_a_delay_that_only_gross_errors_would_tell_leaves_a_status(rng):
    """Without a prior of its own it was infinite, and the status an error."""
    rest, true = np.zeros(6), faulty(UR10E, Cell(), rng)
    given = enumerate(seen(true, 30, rng))
    moved = [replace(s, velocity=rest + (k < 3), position=s.position + (k < 3)) for k, s in given]
    made = session(mode='continuous')
    made.restore([replace(each, acceleration=rest) for each in moved])
    assert 'mm expected' in made.status()
    assert 2e-5 < made.estimate.sigma < 1e-4
