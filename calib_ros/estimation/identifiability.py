# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which parameters a set of poses determines, and how well.

Works on the triangular factor R of the weighted Jacobian (R^T R = J^T W J), not on the normal
matrix, which squares the condition number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from calib_ros.estimation.observations import Observations
from calib_ros.estimation.sizes import TYPICAL
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.inverse import solve
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import FRAME_KINDS, Parameter, parameters_of
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, ROUNDING, FloatArray
from calib_ros.settings import EXCEPTION
from calib_ros.shown import Shown

DEGENERATE = TYPICAL['angle']
"""Extents below this share of the largest count as zero: of board points, or of the rest of a
frame's column after those before it. Orientations that vary by less than an arm's own angle
errors would put a tool anywhere, even kilometres away."""
A_POSE = Observations.from_arrays(np.zeros((1, 0)), np.zeros((1, 3)), np.eye(3)[np.newaxis])


def independent(
    factor: FloatArray, names: Sequence[str], tolerance: FloatArray | float = HALF_THE_DIGITS
) -> tuple[str, ...]:
    """Return the parameters whose columns are independent of those before them.

    `factor` (R, P) is the upper triangular factor of the weighted Jacobian, columns in the order
    of the names: of parameters that trade off against each other, the last are left out and stay
    nominal. At least the share `tolerance` (P,) of a column must be left by those before it, and
    of the largest column more than rounding.
    """
    sizes = np.linalg.norm(factor, axis=0)
    least = np.maximum(tolerance * sizes, ROUNDING * sizes.max(initial=0.0))  # less shows nowhere
    if len(factor) == len(names) and (np.abs(np.diag(factor)) > least).all():
        return tuple(names)  # the diagonal holds the rest of each column
    basis = np.zeros(factor.shape)
    kept: list[str] = []
    for name, column, short in zip(names, factor.T, least.tolist(), strict=True):
        known = basis[:, : len(kept)]
        rest = column - known @ (known.T @ column)
        rest -= known @ (known.T @ rest)  # again: Gram-Schmidt loses orthogonality
        size = math.sqrt(rest @ rest)
        if size > short:
            basis[:, len(kept)] = rest / size
            kept.append(name)
    return tuple(kept)


def excited(factor: FloatArray, names: Sequence[str]) -> tuple[str, ...]:
    """Return the parameters that measured poses determine, by their factor R (P, P)."""
    frames = [Parameter(name).kind in FRAME_KINDS for name in names]
    return independent(factor, names, np.where(frames, DEGENERATE, HALF_THE_DIGITS))


def structurally_independent(
    chain: Chain,
    names: Sequence[str],
    sets: Sequence[Observations] = (A_POSE,),
    extra: Callable[[Chain, Sequence[str]], tuple[FloatArray, FloatArray]] | None = None,
) -> tuple[str, ...]:
    """Return the parameters that many arbitrary poses would determine, measured as in the sets.

    The others are gauge freedoms of the chain, not a lack of measurements. Frames that are not
    fixed get arbitrary places, because a tool of length zero hides rotations. A complete and
    minimal model of an arm with R revolute and P prismatic joints has 4 R + 2 P + 6 parameters by
    full pose (Everett, Driels and Mooring 1987). A target in a socket is in one place in all
    poses: turning the whole cell about it only shows in residuals. So does the size of a cell that
    touches only planes, and turning the cell about a point seen from the flange. A board gives its
    pose in a camera, and images from anywhere give the camera's lens (Zhang 2000). `extra` returns
    further equations at a chain.

    Parameters of which those before them leave little come last: with a known tool near the last
    axis a turn would else imitate a length, and end far away.
    """
    anywhere, rows = drawn(chain, names, sets)
    if extra is not None:
        rows.append(extra(anywhere, names)[0])
    return independent_in(rows, names)


def drawn(
    chain: Chain, names: Sequence[str], sets: Sequence[Observations]
) -> tuple[Chain, list[FloatArray]]:
    """Return a chain with arbitrary frames, and the rows (R, P) of each set at many poses."""
    rng = np.random.default_rng(0)
    joints = chain.random_joints(100, rng)
    frames = [name for name in names if chain.owns_frame(name)]
    places = rng.uniform(0.1, 0.5, len(frames))
    anywhere = chain.with_offsets(dict(zip(frames, places, strict=True)))
    approach = rng.choice(np.array([-1.0, 1.0]), joints.shape)
    velocity = rng.normal(size=joints.shape)
    rows = []
    for number, each in enumerate(sets):
        posed = joints
        if each.socket or each.plane:
            posed, place = _meeting(anywhere, np.roll(joints, number, axis=0), each)
            shift = dict(zip(parameters_of(each.base)[:3], -place, strict=True))
            anywhere = anywhere.with_offsets({n: x for n, x in shift.items() if n in names})
        model = ErrorModel(anywhere, names, each.base, each.tool)
        signs, rates = approach[: len(posed)], velocity[: len(posed)] if each.moving else None
        jacobian = model.jacobian(posed, signs, rates, each.seen)
        if each.width == 1:
            line = anywhere.forward(posed, signs, each.base, each.tool)[:, :3, 3]
            if each.plane:
                line[:] = [0.0, 0.0, 1.0]
            line /= np.linalg.norm(line, axis=1, keepdims=True)
            jacobian = np.einsum('nc,ncp->np', line, jacobian[:, :3])
        elif each.width == 3:
            jacobian = jacobian[:, :3]
        rows.append(jacobian.reshape(-1, len(names)))
    return anywhere, rows


def independent_in(rows: Sequence[FloatArray], names: Sequence[str]) -> tuple[str, ...]:
    """Return the parameters that rows (R, P) at arbitrary poses determine."""
    lens = [k for k, name in enumerate(names) if Parameter(name).of_lens]
    every = [*map(_compact, rows), np.eye(len(names))[lens]]
    first = np.asarray(np.linalg.qr(np.concatenate(every), mode='r'))
    least = [HALF_THE_DIGITS if Parameter(n).kind in FRAME_KINDS else EXCEPTION for n in names]
    strong = independent(first, names, np.array(least))
    order = sorted(range(len(names)), key=lambda k: names[k] not in strong)
    factor = np.asarray(np.linalg.qr(first[:, order], mode='r'))
    found = independent(factor, [names[k] for k in order])
    return tuple(name for name in names if name in found)


def _compact(rows: FloatArray) -> FloatArray:
    """Return R (K, P) with the products of rows (R, P), of which some columns are zero."""
    used = np.flatnonzero(rows.any(axis=0))
    factor = np.zeros((min(len(rows), len(used)), rows.shape[1]))
    factor[:, used] = np.linalg.qr(rows[:, used], mode='r')
    return factor


def identifiable_and_held(
    chain: Chain,
    names: Sequence[str],
    sets: Sequence[Observations],
    extra: Callable[[Chain, Sequence[str]], tuple[FloatArray, FloatArray]] | None = None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the structurally identifiable parameters, and those that only positions determine.

    Sockets and planes alone fit a larger arm in a larger cell as well, and planes a gantry with
    skewed axes. Such parameters of the arm are held at nominal; if the size is one, by the longest
    length, which distorts it least. `extra` returns further equations (R, P) at a chain.
    """
    found = structurally_independent(chain, names, sets, extra)
    if not all(each.width == 1 or each.socket for each in sets):
        return found, ()
    base, tool = sets[0].base, sets[0].tool
    arm = {name for name in names if not chain.owns_frame(name)}
    every = [*parameters_of(base), *parameters_of(tool), *(name for name in names if name in arm)]
    place = A_POSE.changed(oriented=np.zeros(1, dtype=bool), base=base, tool=tool)
    seen = structurally_independent(chain, every, (place,))
    visible = [Parameter(name) for name in seen if name in arm]
    held = [name for name in visible if name not in found]
    sized = not all(each.socket or each.plane for each in sets)
    if not sized and any(name.is_length for name in held):
        lengths = [name for name in visible if name.is_length]
        longest = max(lengths, key=lambda name: abs(chain.value(name)))
        others = [name for name in names if name != longest]
        found = structurally_independent(chain, others, sets, extra)
        held = [longest, *(name for name in visible if name not in (*found, longest))]
    return found, tuple(held)


def best_imitation(
    chain: Chain,
    names: Sequence[str],
    others: Sequence[str],
    joints: FloatArray,
    lever: float,
    approach: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how P named parameters follow a unit of each of K others.

    Their changes (P, K) reproduce the arm's motion by the others best, at joint values (N, n)
    approached with signs `approach` (N, n); a radian counts as `lever` [m]. The motion (6 N, K)
    [m] by the others and its rest follow.
    """
    every = list(dict.fromkeys([*names, *others]))
    rows = ErrorModel(chain, every).jacobian(joints, approach)
    rows[:, 3:] *= lever
    flat = rows.reshape(-1, len(every))
    own, wanted = flat[:, : len(names)], flat[:, [every.index(name) for name in others]]
    scale = np.linalg.norm(own, axis=0)
    scale[scale <= ROUNDING * scale.max(initial=0.0)] = 1.0  # without effect
    found = np.linalg.lstsq(own / scale, wanted, rcond=1e-9)[0] / scale[:, np.newaxis]
    return found, wanted, wanted - own @ found


def _meeting(
    chain: Chain, joints: FloatArray, each: Observations
) -> tuple[FloatArray, FloatArray]:
    """Return joint values (M, n) that bring the target to one place, and that place (3,) [m].

    The place of the first pose, or the median height of a plane. Poses that do not arrive within
    20 steps, stretched, are left out.
    """
    places = chain.forward(joints, base=each.base, tool=each.tool)
    place = places[0, :3, 3].copy()
    if each.plane:
        place[:] = 0.0, 0.0, np.median(places[:, 2, 3])
    places[:, :3, 3] = place
    part = slice(2, 3) if each.plane else slice(3)
    found = solve(chain, places, joints, each.base, each.tool, part, 20)
    return found.joints[found.converged], place


def covariance(factor: FloatArray, middle: FloatArray | None = None) -> FloatArray:
    """Return the covariance (P, P) of the parameters from R, for weights in units of sigma.

    For Gaussian noise of those sigmas (R^T R)^-1 is the Cramer-Rao bound. Otherwise it is (R^T
    R)^-1 M (R^T R)^-1, where `middle` M (P, P) is the normal matrix with every equation weighted
    by its true variance (in units of the assumed one).
    """
    scale = 1.0 / np.linalg.norm(factor, axis=0)
    inverse, failed = lapack.dtrtri(factor * scale)
    inverse *= scale[:, np.newaxis]
    turned = inverse if middle is None else inverse.T @ middle @ inverse
    if failed or not np.isfinite(turned).all():
        raise np.linalg.LinAlgError('singular factor')
    if middle is None:
        return np.asarray(inverse @ inverse.T)
    root, order, rank, _ = lapack.dpstrf(turned, lower=1)  # pivoted
    root[:, rank:] = 0.0  # no rounding below zero
    root = inverse[:, order - 1] @ np.tril(root)
    return np.asarray(root @ root.T)


@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty(Shown):
    """Covariance of the fitted parameters, by source of error.

    `parts` (K, P, P) belong to position, orientation and priors, or to all of these, to parameters
    held at nominal, and to what no parameter explains; `freedom` (K,) are the degrees of freedom
    of each, infinite if the noise is known.
    """

    parts: FloatArray
    freedom: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """Return the covariance (P, P) by all sources."""
        return np.asarray(self.parts.sum(axis=0))

    def with_part(self, part: FloatArray) -> Uncertainty:
        """Return the uncertainty with a further source (P, P) of known size."""
        parts = np.concatenate([self.parts, part[np.newaxis]])
        return Uncertainty(parts, np.append(self.freedom, np.inf))

    @property
    def overall(self) -> float:
        """Return the degrees of freedom of all parameters together."""
        variances = np.einsum('kpp,pp->k', self.parts, np.diag(1.0 / np.diag(self.covariance)))
        return float(self.freedom_of(variances))

    def freedom_of(self, variances: FloatArray) -> FloatArray:
        """Return the degrees of freedom (...) of sums of variances (K, ...) from the sources.

        After Satterthwaite (1946).
        """
        shares = variances / np.maximum(variances.sum(axis=0), 1e-300)
        with np.errstate(divide='ignore'):
            return np.asarray(1.0 / np.tensordot(1.0 / self.freedom, shares**2, axes=1))


def trades(matrix: FloatArray, names: Sequence[str], kept: Sequence[str]) -> dict[str, list[str]]:
    """Return the fitted parameters that each left-out one trades against.

    Moving both by the right amounts leaves every measured pose unchanged. `matrix` (P, P) is the
    normal matrix of all.
    """
    sizes = np.sqrt(np.diag(matrix))
    seen = sizes > ROUNDING * sizes.max(initial=0.0)
    fitted, left_out = (np.flatnonzero(seen & (np.isin(names, kept) == x)) for x in (True, False))
    scaled = matrix[fitted] / sizes[fitted, np.newaxis]
    basis, columns = (scaled[:, part] / sizes[part] for part in (fitted, left_out))
    shares = np.abs(np.linalg.lstsq(basis, columns, rcond=None)[0])
    strong = (shares > DEGENERATE * shares.max(axis=0, initial=0.0)).T
    partners: dict[str, list[str]] = {name: [] for name in names if name not in set(kept)}
    for k, marks in zip(left_out.tolist(), strong, strict=True):
        partners[names[k]] = [names[j] for j in fitted[marks].tolist()]
    return partners


def observability(factor: FloatArray, poses: int) -> dict[str, float]:
    """Return the indices o1 to o5 from R (P, P) of the weighted Jacobian of a number of poses.

    From the singular values, in sigma of the measurement per metre or radian. O1 Borm and Menq
    1991, O2 Driels and Pathre 1990, O3 and O4 Nahvi et al. 1994 and 1996, O5 Sun and Hollerbach
    2008.
    """
    singular = np.asarray(np.linalg.svd(factor, compute_uv=False), dtype=float)
    mean = float(np.exp(np.log(np.maximum(singular, 1e-300)).mean()))
    others = {name: float(each) for name, each in indices_of(singular).items()}
    return {'o1': float(mean / np.sqrt(poses)), **others}


def indices_of(singular: FloatArray) -> dict[str, FloatArray]:
    """Return the indices o2 to o5 (...) of singular values (..., P)."""
    smallest, largest = singular.min(axis=-1), singular.max(axis=-1)
    return {
        'o2': smallest / largest,
        'o3': smallest,
        'o4': smallest**2 / largest,
        'o5': 1.0 / np.sum(1.0 / np.maximum(singular, 1e-300), axis=-1),
    }


def correlated(
    matrix: FloatArray, names: Sequence[str], threshold: float
) -> tuple[tuple[str, str, float], ...]:
    """Return pairs correlated beyond a threshold by their covariance (P, P), strongest first."""
    std = np.sqrt(np.diag(matrix))
    correlation = matrix / np.outer(std, std)
    strong = np.argwhere(np.triu(np.abs(correlation) > threshold, 1)).tolist()
    pairs = [(names[i], names[j], float(correlation[i, j])) for i, j in strong]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair[2])))
