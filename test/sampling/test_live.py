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
from calib_ros.sampling import live as live_module
from calib_ros.sampling.live import START, LiveEstimate, barely_moved


def session(**settings):
    return CalibrationSession(UR10E, Settings(**SIGMAS | settings))


def growing(samples, **settings):
    """Return a live estimate that has seen a list grow, and what it said each time."""
    live = LiveEstimate(session(**settings).problem_of)
    said = [live.update(samples[: k + 1]) for k in range(len(samples))]
    return live, said


def apart(first, second, rng):
    """Return the RMS distance [m] of what two chains predict."""
    return rms(first, second, UR10E.random_joints(300, rng))


@pytest.mark.parametrize(('oriented', 'seed'), [(True, 1), (False, 2)])
def test_at_the_end_it_is_the_batch(oriented, seed):
    rng = np.random.default_rng(seed)
    samples = seen(faulty(UR10E, Cell(), rng), 80, rng, oriented)
    live, said = growing(samples)
    batch = identify(session().problem_of(samples))
    assert apart(said[-1].chain, batch.chain, rng) < 0.05 * NOISE[0]
    assert said[-1].noise == pytest.approx(1.0, abs=0.15)
    predicted = np.sqrt(np.mean(batch.predicted_sigma() ** 2))
    assert said[-1].sigma == pytest.approx(predicted, rel=0.25)
    assert live.suspicious == []


def test_it_begins_early_and_only_gets_better(rng):
    _, said = growing(seen(faulty(UR10E, Cell(), rng), 60, rng))
    assert said[: START - 1] == [None] * (START - 1)
    sigmas = [each.sigma for each in said if each is not None]
    assert len(sigmas) == 60 - START + 1
    assert sigmas[-1] < 0.2 * sigmas[0]
    more = said[-1].more_for(0.5 * said[-1].sigma)
    assert more == pytest.approx(3 * 60, abs=1)
    assert said[-1].more_for(2.0 * said[-1].sigma) == 0


def test_fewer_rows_than_parameters_have_the_noise_that_is_stated(rng):
    samples = seen(faulty(UR10E, Cell(), rng), 20, rng, oriented=False)
    said = [each for each in growing(samples)[1] if each is not None]
    few = [3 * each.samples <= len(each.names) for each in said]
    assert {each.noise for each, less in zip(said, few, strict=True) if less} == {1.0}
    assert 1.0 not in {each.noise for each, less in zip(said, few, strict=True) if not less}


def test_many_samples_are_taken_by_and_by(rng, monkeypatch):
    """An update is short whatever waits, and in the end nothing has been left out."""
    monkeypatch.setattr(live_module, 'SOME', 40)
    monkeypatch.setattr(live_module, 'MOST_AT_ONCE', 25)
    true = faulty(UR10E, Cell(), rng)
    samples = seen(true, 80, rng) + [
        replace(sample, target='other', stamp_ns=sample.stamp_ns + 10**6)
        for sample in seen(true, 40, rng)
    ]
    live = LiveEstimate(session().problem_of)
    counts = [live.update(samples).samples for _ in range(6)]
    assert counts[0] <= 42
    assert all(0 <= step <= 25 for step in np.diff(counts))
    assert counts[-2:] == [120, 120]
    _, said = growing(samples)
    assert apart(said[-1].chain, live.update(samples).chain, rng) < 0.1 * NOISE[0]


def test_what_it_does_not_begin_with_is_taken_next(rng, monkeypatch):
    """Of many samples of one target and few of another it begins with a part of the many."""
    monkeypatch.setattr(live_module, 'SOME', 60)
    true = faulty(UR10E, Cell(), rng)
    samples = seen(true, 50, rng) + seen(true, 8, rng, start=100, target='other')
    live = LiveEstimate(session().problem_of)
    assert [live.update(samples).samples for _ in range(3)] == [31 + 8, 58, 58]


@pytest.mark.parametrize(
    ('oriented', 'places'),
    [(False, [0, 3, 8]), (True, list(range(START))), (False, list(range(START)))],
)
def test_gross_errors_among_the_first_samples_are_found_later(oriented, places, rng):
    """However the estimate bent to them: at the end it is that of the good ones alone."""
    samples = seen(faulty(UR10E, Cell(), rng), 50, rng, oriented)
    for k in places:
        way = rng.normal(size=3)
        shift = rng.uniform(5e-3, 50e-3) * way / np.linalg.norm(way)
        samples[k] = replace(samples[k], position=samples[k].position + shift)
    live, said = growing(samples)
    assert set(live.suspicious) == {samples[k] for k in places}
    good = [each for k, each in enumerate(samples) if k not in places]
    batch = identify(session().problem_of(good))
    assert said[-1].samples == len(good)
    assert apart(said[-1].chain, batch.chain, rng) < 0.05 * NOISE[0]


def test_with_many_parameters_it_begins_with_the_shorter_fit(rng, monkeypatch):
    """It finds the same gross errors, for which the thorough one would take seconds."""
    monkeypatch.setattr(live_module, 'MOST_THOROUGH', 20)
    monkeypatch.setattr(live_module, 'thorough_fit', lambda *arguments: pytest.fail('too long'))
    samples = seen(faulty(UR10E, Cell(), rng), 50, rng)
    wrong = rng.choice(50, 5, replace=False).tolist()
    for k in wrong:
        samples[k] = replace(samples[k], position=samples[k].position + 5e-3)
    live, _ = growing(samples)
    assert set(live.suspicious) == {samples[k] for k in wrong}


def test_samples_that_early_ones_speak_against_come_back(rng):
    """The target was knocked after twenty samples; forty more, and those of before are wrong."""
    true = faulty(UR10E, Cell(), rng)
    knocked = replace(true, tool=true.tool.moved({'x': 5e-3}))
    samples = seen(true, 20, rng) + seen(knocked, 40, rng, start=20)
    live, _ = growing(samples[:30])
    assert set(live.suspicious) == set(samples[20:30])
    live, said = growing(samples)
    assert set(live.suspicious) == set(samples[:20])
    assert apart(said[-1].chain, knocked, rng) < 3.0 * said[-1].sigma


def test_good_samples_are_not_flagged_where_the_noise_is_larger_than_given(rng):
    given = {name: sigma / 5.0 for name, sigma in SIGMAS.items()}
    live, _ = growing(seen(faulty(UR10E, Cell(), rng), 60, rng), **given)
    assert live.suspicious == []


def test_several_devices_and_targets(rng):
    """A second tracker, another target and a wire join in one after the other."""
    true = faulty(UR10E, Cell(), rng)
    other = replace(true, base=random_frame(rng, 2.0))
    third = replace(true, tool=random_frame(rng, 0.3))
    samples = seen(true, 30, rng)
    samples += seen(other, 20, rng, start=100, device='B')
    samples += seen(third, 20, rng, oriented=False, start=200, target='ball')
    live, said = growing(samples)
    batch = identify(session().problem_of(samples))
    assert set(said[-1].chain.frame_names) == {'base', 'tool', 'base_B', 'tool_ball'}
    assert apart(said[-1].chain, batch.chain, rng) < 0.1 * NOISE[0]
    assert live.suspicious == []


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
    live = LiveEstimate(session().problem_of)
    assert [live.update(samples[:k]).samples for k in (70, 80)] == [70, 79]
    assert live.suspicious == [samples[77]]


def test_samples_that_make_no_problem_yet_are_told_or_waited_for(rng, monkeypatch):
    samples = seen(faulty(UR10E, Cell(), rng), 20, rng)
    live = LiveEstimate(session().problem_of)
    assert live.update([*samples, *by_wire(samples, 1e3)]) is None
    assert 'are they in metres' in live.known.refused
    with monkeypatch.context() as failing:
        failing.setattr(live_module, 'start_frames', lambda *_: np.linalg.inv(np.zeros((1, 1))))
        assert live.update(samples) is None
    assert live.known.refused == ''
    assert live.update(samples).samples == 20


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
    found = LiveEstimate(session(**given).problem_of).update(samples)
    assert found.excess == pytest.approx(np.sqrt(9.0 - 8.0 * share), rel=0.15)


def test_held_out_samples_are_not_fitted(rng):
    true = faulty(UR10E, Cell(), rng)
    samples = seen(true, 40, rng)
    _, alone = growing(samples)
    judges = seen(faulty(UR10E, Cell(), rng), 20, rng, start=100, validation=True)
    mixed = [each for pair in zip(samples, judges * 2, strict=True) for each in pair]
    live, said = growing(mixed)
    assert apart(said[-1].chain, alone[-1].chain, rng) < 1e-9
    assert said[-1].samples == 40
    assert live.suspicious == []


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
    live, _ = growing(samples)
    good = seen(true, 30, rng, start=50)
    for k in range(30):
        estimate = live.update([*samples, *good[: k + 1]])
    assert apart(estimate.chain, true, rng) < 4.0 * estimate.sigma
    assert estimate.sigma < NOISE[0]
    assert live.suspicious == []


def test_after_a_restart_a_sample_that_was_taken_back_counts_no_longer(rng):
    samples = seen(faulty(UR10E, Cell(), rng), 40, rng)
    live, _ = growing(samples)
    live.restart()
    expected = LiveEstimate(session().problem_of).update(samples[:30])
    found = live.update(samples[:30])
    assert found.samples == 30
    assert apart(found.chain, expected.chain, rng) < 1e-12


def test_joints_that_hardly_moved_are_named():
    held = Joint('held', lower=0.0, upper=0.0)
    chain = Chain('arm', 'standard', (Joint('a'), Joint('b'), Joint('c', 'prismatic'), held))
    joints = np.array([[0.0, 0.0, 0.0, 0.0], [1.0, 0.3, 0.02, 0.0], [-1.0, 0.1, 0.1, 0.0]])
    assert barely_moved(chain, joints) == ('b',)
    assert barely_moved(chain, joints[:1]) == ('a', 'b', 'c')
