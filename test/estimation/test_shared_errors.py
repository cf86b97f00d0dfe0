# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E, along_path, fitted, measured_arm
from scipy.signal import lfilter
from scipy.spatial.distance import cdist
from scipy.stats import norm

from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.estimation import quadratic_forms, samples as samples_module, shared_errors
from calib_ros.estimation.fading import DECAYS, faded_in_succession, faded_near
from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.stops import ELSEWHERE, Stops, gather
from calib_ros.estimation.system import System
from calib_ros.identification.identification import identify
from calib_ros.report.documents import as_document
from calib_ros.report.words import neighbours_in_words


def fading(count, length, rng):
    """Return (count, 3) errors of unit variance that decay over a number of poses."""
    decay = np.exp(-1.0 / length)
    steps = np.sqrt(1.0 - decay**2) * rng.normal(size=(count, 3))
    steps[0] /= np.sqrt(1.0 - decay**2)
    return lfilter([1.0], [1.0, -decay], steps, axis=0)


def shifted(seen, errors):
    return replace(seen, positions=seen.positions + errors)


def run(
    seed, count=60, order='path', drift=None, oriented=True, amplitude=1e-4, identified=fitted
):
    """Return the true arm and a fit of it with a drifting tracker."""
    rng = np.random.default_rng(seed)
    true = faulty(UR10E, Cell(), rng)
    q = along_path(count, rng) if order == 'path' else UR10E.random_joints(count, rng)
    seen = measure(true, q, rng, *NOISE, oriented=oriented)
    if drift is not None:
        seen = shifted(seen, amplitude * fading(count, drift, rng))
    return true, identified(Problem(UR10E, seen, **SIGMAS))


def hits(true, result, widened=True):
    """Return for each parameter whether its 95 % interval holds the truth."""
    factor = 1.0 if widened else result.noise.widened
    return [
        abs(p.value - true.value(p.name)) <= p.half_width() / factor
        for p in result.parameters
        if p.std is not None
    ]


def test_independent_errors_stay_independent():
    """At 99 %: of 20 sessions with nothing shared three are said to share once in 1000 times."""
    found = [run(seed, 48, ('path', 'random')[seed % 2])[1] for seed in range(20)]
    assert sum(bool(result.noise.shared) for result in found) <= 2
    # and then standard deviations are those of the Cramer-Rao bound, by the noise given or found
    quiet = [result for result in found if not result.noise.shared and result.noise.consistent]
    assert len(quiet) > 15
    assert all(result.noise.widened == 1.0 for result in quiet)
    assert all(p.freedom > 100 for result in quiet for p in result.parameters if p.std)


def test_intervals_hold_the_truth_though_the_tracker_drifts():
    """12 sessions of 30 parameters: their coverage spreads by 0.06 a session, 0.017 in all."""
    runs = [run(seed, drift=10.0) for seed in range(12)]
    assert all('successive' in result.noise.shared for _, result in runs)
    covered = np.mean([hits(*each) for each in runs])
    alone = np.mean([hits(*each, widened=False) for each in runs])
    assert covered == pytest.approx(0.95, abs=0.025)
    assert alone < 0.925


def test_distances_drift_as_well():
    rng, _, seen = measured_arm(4, 300, (0.0, 0.0))
    length = np.linalg.norm(seen.positions, axis=1) + 5e-5 * rng.normal(size=300)
    for drift, shared in ((0.0, ()), (2e-4, ('successive',))):
        wire = replace(seen, distances=length + drift * fading(300, 20.0, rng)[:, 0])
        assert identify(Problem(UR10E, wire, **SIGMAS)).noise.shared == shared


@pytest.mark.parametrize('block', [1, 24, 96])  # 24: the last one holds a single stop
def test_errors_in_succession_have_the_kernel_of_their_distance_in_time(monkeypatch, block):
    monkeypatch.setattr(samples_module, 'BLOCK', block)
    rng = np.random.default_rng(11)
    number = np.minimum(np.arange(73), 70)  # a block may end within the last stop
    seen = measure(UR10E, along_path(96, rng)[number], rng, *NOISE)
    samples, names = samples_module.Samples(seen, *NOISE), UR10E.parameter_names
    system, kernels = System((samples,)), [(3.0, 2.0), (20.0, 0.5)]
    apart = np.abs(np.subtract.outer(number, number))
    kernel = sum(size * np.exp(-apart / length) for length, size in kernels)
    rows = samples.rows_of(UR10E, names).T[..., :-1]
    found = faded_in_succession(UR10E, names, system, {0: kernels, 1: kernels})
    for part, own in enumerate((rows[:, :3], rows[:, 3:])):
        expected = np.einsum('ncp,nm,mcr->pr', own, kernel, own, optimize=True)
        np.testing.assert_allclose(found[part], expected, rtol=1e-9, atol=1e-9 * expected.max())


def test_the_report_says_what_is_shared_and_what_follows():
    _, drifting = run(9, drift=10.0, amplitude=3e-4, identified=identify)
    text = neighbours_in_words(drifting.noise)
    assert 'measured in succession (0.' in text
    assert f'{drifting.noise.widened:.2f} times as large' in text
    document = as_document(drifting, {})
    assert document['noise_in_sigma']['shared'][0] == 'successive'
    for parameter in document['parameters'].values():
        if parameter['std'] is not None:
            assert parameter['half_width_95'] > 1.95 * parameter['std']
    _, quiet = run(9, identified=identify)
    assert 'No errors shared' in neighbours_in_words(quiet.noise)


def drawn(rng, count=20, width=4):
    """Return stops, every third of them without orientation."""
    parts = [rng.normal(size=(width + 1, 3, count)) for _ in range(2)]
    parts[1][:, :, ::3] = 0.0
    place = rng.normal(size=(count, 2))
    return Stops(parts, np.ones(count), place, np.arange(count, dtype=float), place)


def test_the_moments_of_the_forms_leave_out_what_was_not_measured():
    """Against the same traces of whole matrices."""
    count, width = 20, 4
    units = drawn(np.random.default_rng(0), count, width)
    units.place[1::2] = units.place[::2]  # each visited twice
    parts, forms = units.parts, quadratic_forms.QuadraticForms(units, np.zeros((0, width)))
    rows = np.concatenate([part.reshape(width + 1, -1).T for part in parts])
    basis = np.linalg.qr(rows[:, :-1])[0]
    measured = np.concatenate([part.any(axis=0).ravel() for part in parts])
    left = np.diag(measured.astype(float)) - basis @ basis.T

    def whole(part, matrix):
        shares = np.zeros((2, 2))
        shares[part, part] = 1.0
        return np.kron(shares, np.kron(np.eye(3), matrix))

    kernels = [('successive', 5.0), ('near', 0.3)]
    cases = [(part, units.kernel(*kernel)) for part in (0, 1) for kernel in kernels]
    expected = [
        [np.trace(whole(*first) @ left @ whole(*second) @ left) for second in cases]
        for first in cases
    ]
    matrices = np.array([units.kernel(*kernel) for kernel in kernels])
    found = forms._moments(dict.fromkeys((0, 1), matrices))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    links = units.links('successive')
    dense = whole(1, links.toarray())
    free = left[60:, 60:]
    ratio = np.trace(dense @ left) / np.trace(free)
    centred = dense @ left - ratio * whole(1, np.eye(count)) @ left
    residual = left @ rows[:, -1]
    excess = residual @ dense @ residual - ratio * (residual[60:] ** 2).sum()
    excess *= np.trace(free) / (residual[60:] ** 2).sum()
    score = excess / np.sqrt(2.0 * np.trace(centred @ centred))
    pairs = measured.astype(float) @ dense @ measured
    assert forms.test(1, links) == pytest.approx((excess / pairs, score), rel=1e-9)


def test_where_no_more_was_measured_than_fitted_nothing_is_shared():
    """One residual is all that 20 images of 2 means each leave of 39 parameters."""
    rng = np.random.default_rng(0)
    count, kernels = 20, [(kind, x) for kind, xs in DECAYS.items() for x in xs]
    for _ in range(20):
        place, time = rng.normal(size=(count, 2)), np.arange(count, dtype=float)
        parts = [rng.normal(size=(2 * count, 2, count)), np.zeros((2 * count, 3, count))]
        units = Stops(parts, np.ones(count), place, time, place)
        forms = quadratic_forms.QuadraticForms(units, np.zeros((0, 2 * count - 1)))
        assert forms.test(0, units.links('near')) == (0.0, 0.0)
        sizes = forms.sizes({0: kernels})[0]
        assert np.isfinite(sizes).all()
        assert (sizes >= 0.0).all()


def test_neighbours_are_the_next_stop_and_the_three_nearest():
    """Within a set: those of another are far away in both senses, however few its own are."""
    rng = np.random.default_rng(0)
    count, far = 14, ELSEWHERE
    number = np.repeat([0.0, 1.0], [11, 3])
    place = np.column_stack([rng.normal(size=(count, 2)), far * number])
    time = np.array([0, 1, 2, 4, 5, 6, 7, 9, 10, 12, 13, 3, 4, 6]) + far * number
    units = Stops([], np.arange(1.0, 15.0), place, time, place)
    assert len(units) == count
    apart = cdist(place, place)
    nearest = np.argsort(apart, axis=1)[:, 1:4]
    expected = np.zeros((count, count))
    expected[np.arange(count)[:, np.newaxis], nearest] = 1.0
    expected = np.maximum(expected, expected.T)
    assert expected[:11, 11:].any()  # the third nearest of a set of three is in the other one
    expected[:11, 11:] = expected[11:, :11] = 0.0
    np.testing.assert_array_equal(units.links('near').toarray(), expected)
    follows = np.abs(np.subtract.outer(time, time)) == 1.0
    np.testing.assert_array_equal(units.links('successive').toarray(), follows)
    for kind, distance in (('near', apart), ('successive', np.abs(np.subtract.outer(time, time)))):
        root = np.sqrt(np.outer(units.count, units.count))
        np.testing.assert_allclose(units.kernel(kind, 0.7), root * np.exp(-distance / 0.7))


@pytest.mark.parametrize('block', [5, samples_module.BLOCK])
@pytest.mark.parametrize(('share', 'run'), [(1, 1), (2, 3)])
def test_stops_have_the_sums_of_their_samples(share, run, block, monkeypatch):
    """Over the root of their number, of all sets; weightless samples are none."""
    monkeypatch.setattr(samples_module, 'BLOCK', block)
    rng = np.random.default_rng(1)
    repeats = rng.integers(1, 4, size=14)
    stops = np.repeat(np.arange(14), repeats)
    q = UR10E.random_joints(14, rng)[stops]
    poses = measure(UR10E, q, rng, *NOISE)
    points = measure(UR10E, q[stops < 9], rng, *NOISE, oriented=False)
    own = np.diag(np.repeat(NOISE, 3) ** 2) + 1e-9  # whitened, a pose is one part
    weights = np.where(np.arange(len(q)) == 3, 0.0, rng.uniform(0.5, 1.0, len(q)))
    sets = (
        samples_module.Samples(points, *NOISE),
        samples_module.Samples(poses, *NOISE).weighted(weights),
        samples_module.Samples(replace(poses, covariance=np.tile(own, (len(q), 1, 1))), *NOISE),
    )
    names = UR10E.parameter_names[:8]
    units = gather(UR10E, names, System(sets), share, run)
    parts, counts, places, times = [[], []], [], [], []
    for number, samples in enumerate(sets):
        rows = samples.rows_of(UR10E, names)
        rows = np.pad(rows, ((0, 0), (0, 6 - rows.shape[1]), (0, 0)))
        good = np.ones(samples.count) if samples.weights is None else samples.weights > 0.0
        for stop in range(9 if number == 0 else 14):
            which = np.flatnonzero((stops[: samples.count] == stop) & (good > 0))
            if stop // run % share == 0 and len(which):
                whole = rows[..., which].sum(axis=2) / np.sqrt(len(which))
                first = 6 if number == 2 else 3
                parts[0].append(np.pad(whole[:, :first], ((0, 0), (0, 6 - first))))
                parts[1].append(whole[:, 3:] * (number < 2))
                counts.append(len(which))
                here = q[which[0]]
                far = ELSEWHERE * number
                places.append([*np.cos(here), *np.sin(here), far])
                times.append(stop + far)
    for found, expected in zip(units.parts, parts, strict=True):
        np.testing.assert_allclose(found, np.stack(expected, axis=2), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(units.count, counts)
    np.testing.assert_allclose(units.place, places, atol=1e-12)
    np.testing.assert_array_equal(units.time, times)


def test_the_rows_of_long_stops_are_never_all_in_memory():
    rng = np.random.default_rng(1)
    seen = measure(UR10E, np.repeat(UR10E.random_joints(8, rng), 5000, axis=0), rng, *NOISE)
    system = System((samples_module.Samples(seen, *NOISE),))
    names = UR10E.parameter_names
    tracemalloc.start()
    units = gather(UR10E, names, system, 1, 20)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert units.count.tolist() == 8 * [5000]
    assert most < 0.5 * 8 * len(seen) * 6 * len(names)


def test_errors_near_in_joint_space_have_the_kernel_of_their_distance():
    """From every third stop: sums over stops grow by three, sums over pairs by nine."""
    units = drawn(np.random.default_rng(2))
    kernel = np.exp(-cdist(units.place, units.place) / 0.8)
    for part, rows in enumerate(units.parts):
        own = rows[:-1]
        for share in (1, 3):
            whole = share**2 * kernel
            np.fill_diagonal(whole, share)
            expected = np.einsum('pcn,nm,rcm->pr', own, whole, own)
            found = faded_near(units, part, [(0.8, 1.0)], share)
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('width', [4, 9])  # fewer rows of 20 stops than columns, and more
def test_sizes_are_those_that_make_the_forms_as_large_as_they_are(width, monkeypatch):
    """Forms of exactly the expected values give back the sizes, of both parts."""
    units = drawn(np.random.default_rng(3), width=width)
    extra = np.random.default_rng(4).normal(size=(2, width))
    forms = quadratic_forms.QuadraticForms(units, extra)
    assert [*forms.parts] == [0, 1]
    kernels = {0: [('successive', 5.0), ('near', 0.5)], 1: [('near', 0.5)]}
    truth = [np.array([2.0, 0.0, 0.7]), np.array([0.3, 5.0])]
    matrices = {
        part: np.array([np.eye(20), *(units.kernel(*kernel) for kernel in own)])
        for part, own in kernels.items()
    }
    values, moments = forms._values(matrices), forms._moments(matrices)
    monkeypatch.setattr(forms, '_values', lambda _: moments @ np.concatenate(truth))
    found = forms.sizes(kernels)
    for part in (0, 1):
        np.testing.assert_allclose(found[part], truth[part], rtol=1e-6, atol=1e-9)
    residual = np.concatenate([part[-1].ravel() for part in units.parts] + [[0.0, 0.0]])
    rows = [part[:-1].reshape(width, -1).T for part in units.parts]
    basis = np.linalg.qr(np.concatenate([*rows, extra]))[0]
    residual -= basis @ (basis.T @ residual)
    own = residual[:120].reshape(2, 3, 20)
    forms = [np.einsum('cn,knm,cm->k', own[part], matrices[part], own[part]) for part in (0, 1)]
    np.testing.assert_allclose(values, np.concatenate(forms))
    measured = np.concatenate([part.any(axis=0).ravel() for part in units.parts])
    left = np.diag(measured.astype(float)) - basis[:120] @ basis[:120].T
    axes = np.kron(np.eye(2), np.ones(3))
    whole = [np.kron(np.diag(axes[part]), each) for part in (0, 1) for each in matrices[part]]
    traces = [[np.trace(one @ left @ other @ left) for one in whole] for other in whole]
    np.testing.assert_allclose(moments, traces, rtol=1e-9)


def test_effects_that_only_their_prior_tells_take_nothing():
    """Waves of a joint that turns little are alike: combinations of them are left out."""
    rng = np.random.default_rng(5)
    units, waves = drawn(rng, width=9), rng.normal(size=(6, 2))
    for part in units.parts:
        part[2:8] = np.tensordot(waves, part[2:4].copy(), 1)
    extra = np.diag([0.0, 0.0, *6 * [0.7], 0.0])
    plain, fewer = (
        quadratic_forms.QuadraticForms(units, extra, alike) for alike in ((), [[*range(2, 8)]])
    )
    assert [forms.parts[0][0].shape[2] for forms in (plain, fewer)] == [9, 5]
    kernels = {0: [('successive', 5.0), ('near', 0.5)], 1: [('near', 0.5)]}
    for part in (0, 1):
        links = units.links('near')
        np.testing.assert_allclose(fewer.test(part, links), plain.test(part, links), rtol=1e-9)
        found, expected = (forms.sizes(kernels)[part] for forms in (fewer, plain))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_effects_of_one_joint_with_one_prior_may_be_combined():
    waves = ('elbow_joint.sin_3', 'elbow_joint.cos_3', 'wrist_1_joint.sin_3', 'elbow_joint.sin_1')
    chain = UR10E.with_effects(waves)
    names = ('elbow_joint.a', *waves, 'base.x')
    extra = np.diag([2.0, 5.0, 5.0, 5.0, 3.0, 0.0])
    assert shared_errors._alike(chain, names, extra) == [[1, 2], [3], [4]]
    assert not shared_errors._alike(chain, names, extra[:0])


def test_where_nothing_is_left_nothing_is_shared():
    units = drawn(np.random.default_rng(6))
    for part in units.parts:
        part[-1] = 0.0
    forms = quadratic_forms.QuadraticForms(units, np.zeros((0, 4)))
    assert forms.test(0, units.links('near')) == (0.0, 0.0)


def test_too_few_stops_share_nothing():
    """Fewer than tell how large a spread is."""
    _, true, seen = measured_arm(0, 7)
    system = System((samples_module.Samples(seen, *NOISE),))
    names = [name for name in UR10E.parameter_names if UR10E.owns_frame(name)]
    found = shared_errors.shared_errors(minimise(true, names, system), names, system)
    assert (found.successive, found.near, found.found, found.middles) == (0.0, 0.0, (), {})
    weightless = system.weighted([np.zeros(7)])
    assert not len(gather(true, names, weightless, 1, 20))


@pytest.mark.parametrize('most', [400, 20])
def test_the_middle_is_the_sum_of_all_that_a_test_finds(most, monkeypatch):
    """White, near and successive errors by their sizes; a score decides, at 99 % of all tests."""
    monkeypatch.setattr(shared_errors, 'MOST_STOPS', most)
    rng = np.random.default_rng(5)
    seen = measure(UR10E, UR10E.random_joints(24, rng), rng, *NOISE)
    system, names = System((samples_module.Samples(seen, *NOISE),)), UR10E.parameter_names[:9]
    fit = minimise(UR10E, names, system)
    limit = norm.ppf(1.0 - 0.01 / 4)
    scores = {('successive', 0): limit + 1e-6, ('near', 0): 9.0, ('near', 1): limit - 1e-6}
    scores |= {('successive', 1): 9.0}
    share = 1 if most > 24 else 2  # every second one of 24 stops, at most 20
    kinds = iter(['successive'] * 2 + ['near'] * 2)
    sizes = {0: np.array([2.0, 0, 0, 0.3, 0, 0, 0, 0.0, 0.7]), 1: np.zeros(6)}

    def test(forms, part, _):
        assert forms._units.time.tolist() == [*range(0, 24, share)]
        kind = next(kinds)
        return 0.1 * (1 + part) * (1 if kind == 'near' else -1), scores[kind, part]

    def sized(_, kernels):
        successive = [('successive', length) for length in (1.0, 3.0, 10.0, 30.0, 100.0)]
        assert kernels == {
            0: [*successive, *(('near', x) for x in (0.3, 1.0, 3.0))],
            1: successive,
        }
        return sizes

    monkeypatch.setattr(quadratic_forms.QuadraticForms, 'test', test)
    monkeypatch.setattr(quadratic_forms.QuadraticForms, 'sizes', sized)
    found = shared_errors.shared_errors(fit, names, system)
    assert (found.successive, found.near) == (0.0, 0.2)
    assert found.found == ('successive', 'near')
    rows = system.rows_of(fit.chain, names)[0][:-1, :3]
    time = np.arange(24)
    place = np.concatenate([np.cos(seen.joints), np.sin(seen.joints)], axis=1)
    kept = time % share == 0
    near = 0.7 * share * np.exp(-cdist(place, place) / 3.0)
    near = near * np.outer(kept, kept) * np.where(np.eye(24, dtype=bool), 1.0, share)
    kernel = 2.0 * np.eye(24) + 0.3 * np.exp(-np.abs(np.subtract.outer(time, time)) / 10.0) + near
    expected = np.einsum('pcn,nm,rcm->pr', rows, kernel, rows)
    assert list(found.middles) == [0]
    np.testing.assert_allclose(found.middles[0], expected, rtol=1e-9, atol=1e-6)
