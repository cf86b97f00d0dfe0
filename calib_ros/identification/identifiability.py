# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which parameters a set of poses determines, and how well.

Works on the triangular factor R of the weighted Jacobian (R^T R = J^T W J), not on the normal
matrix, which squares the condition number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from calib_ros.identification.sizes import TYPICAL
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.inverse import solve
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import FRAME_KINDS, Parameter, parameters_of
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, ROUNDING, FloatArray
from calib_ros.shown import Shown

DEGENERATE = TYPICAL['angle']
"""Share of the largest extent up to which there is none: of points of a board, of the column of a
base or tool frame that those before it leave. Orientations that vary by a milliradian vary by no
more than an arm's own errors: a tool that follows from them would be anywhere, kilometres away as
well."""


def independent(
    factor: FloatArray, names: Sequence[str], frame_tolerance: float = HALF_THE_DIGITS
) -> tuple[str, ...]:
    """Return the parameters whose columns are independent of those before them.

    `factor` (P, P) is the upper triangular one of the weighted Jacobian, with columns in the order
    of the names, the most wanted first: of the parameters that trade against each other, the last
    ones are left out (and so stay nominal). So much of a frame's column must be left by those
    before it, HALF_THE_DIGITS of others.
    """
    frames = [Parameter(name).kind in FRAME_KINDS for name in names]
    least = np.where(frames, frame_tolerance, HALF_THE_DIGITS) * np.linalg.norm(factor, axis=0)
    if len(factor) == len(names) and (np.abs(np.diag(factor)) > least).all():
        return tuple(names)  # the diagonal is what is left of each
    basis = np.zeros(factor.shape)
    kept: list[str] = []
    for name, column, short in zip(names, factor.T, least.tolist(), strict=True):
        known = basis[:, : len(kept)]
        rest = column - known @ (known.T @ column)
        rest -= known @ (known.T @ rest)  # once more: Gram-Schmidt loses orthogonality
        size = math.sqrt(rest @ rest)
        if size > short and size > 0.0:
            basis[:, len(kept)] = rest / size
            kept.append(name)
    return tuple(kept)


def excited(factor: FloatArray, names: Sequence[str]) -> tuple[str, ...]:
    """Return the parameters that measured poses determine, by their factor R (P, P).

    Frames by more than arms' errors.
    """
    return independent(factor, names, DEGENERATE)


@dataclass(frozen=True)
class Kind:
    """What a set of observations measures, and between which frames."""

    oriented: bool = True
    distance: bool = False
    moving: bool = False
    base: str = 'base'
    tool: str = 'tool'
    socket: bool = False
    plane: bool = False

    @property
    def rows(self) -> int:
        """Return the number of equations of one configuration."""
        return 1 if self.distance else 6 if self.oriented else 3


def structurally_independent(
    chain: Chain,
    names: Sequence[str],
    kinds: Sequence[Kind] = (Kind(),),
    extra: Callable[[Chain, Sequence[str]], tuple[FloatArray, FloatArray]] | None = None,
) -> tuple[str, ...]:
    """Return the parameters that a large number of arbitrary poses would determine.

    What is left out is a gauge freedom of the chain, not a lack of measurements. Frames that are
    not fixed are taken anywhere, because a tool of length zero hides rotations. A complete and
    minimal model of an arm with R revolute and P prismatic joints has 4 R + 2 P + 6 parameters
    by full pose (Everett, Driels and Mooring 1987). A target in a socket is where it is in all
    poses: turning the whole cell about it shows nowhere else than in residuals. So does the size
    of a cell that touches planes alone. A board tells its pose in a camera, and images of it from
    anywhere tell the camera's lens (Zhang 2000). `extra` returns further equations at a chain.
    """
    rng = np.random.default_rng(0)
    joints = chain.random_joints(100, rng)
    frames = [name for name in names if chain.owns_frame(name)]
    places = rng.uniform(0.1, 0.5, len(frames))
    anywhere = chain.with_offsets(dict(zip(frames, places, strict=True)))
    approach, velocity = rng.choice([-1.0, 1.0], joints.shape), rng.normal(size=joints.shape)
    rows = []
    for number, kind in enumerate(kinds):
        posed = joints
        if kind.socket or kind.plane:
            posed, place = _meeting(anywhere, np.roll(joints, number, axis=0), kind)
            shift = dict(zip(parameters_of(kind.base)[:3], -place, strict=True))
            anywhere = anywhere.with_offsets({n: x for n, x in shift.items() if n in names})
        model = ErrorModel(anywhere, names, kind.base, kind.tool)
        came, rates = approach[: len(posed)], velocity[: len(posed)] if kind.moving else None
        jacobian = model.jacobian(posed, came, rates)
        if kind.distance:
            line = anywhere.forward(posed, came, kind.base, kind.tool)[:, :3, 3]
            if kind.plane:
                line[:] = [0.0, 0.0, 1.0]
            line /= np.linalg.norm(line, axis=1, keepdims=True)
            jacobian = np.einsum('nc,ncp->np', line, jacobian[:, :3])
        elif not kind.oriented:
            jacobian = jacobian[:, :3]
        rows.append(jacobian.reshape(-1, len(names)))
    if extra is not None:
        rows.append(extra(anywhere, names)[0])
    lens = [k for k, name in enumerate(names) if Parameter(name).of_lens]
    rows.append(np.eye(len(names))[lens])
    return independent(np.asarray(np.linalg.qr(np.concatenate(rows), mode='r')), names)


def told_and_held(
    chain: Chain,
    names: Sequence[str],
    kinds: Sequence[Kind],
    extra: Callable[[Chain, Sequence[str]], tuple[FloatArray, FloatArray]] | None = None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what arbitrary poses would determine, and what of the arm positions would besides.

    What is measured may not tell all that shows in positions: sockets and planes alone would be
    met as well by a larger arm in a larger cell, and planes by a gantry whose axes are askew. That
    is held nominal; if the size is, it is the longest length, which spoils it least. `extra`
    returns further equations (R, P) at a chain.
    """
    told = structurally_independent(chain, names, kinds, extra)
    if not all(kind.distance or kind.socket for kind in kinds):
        return told, ()
    base, tool = kinds[0].base, kinds[0].tool
    arm = {name for name in names if not chain.owns_frame(name)}
    every = [*parameters_of(base), *parameters_of(tool), *(name for name in names if name in arm)]
    seen = structurally_independent(chain, every, (Kind(False, base=base, tool=tool),))
    shown = [Parameter(name) for name in seen if name in arm]
    held = [name for name in shown if name not in told]
    sized = not all(kind.socket or kind.plane for kind in kinds)
    if not sized and any(name.is_length for name in held):
        lengths = [name for name in shown if name.is_length]
        longest = max(lengths, key=lambda name: abs(chain.value(name)))
        others = [name for name in names if name != longest]
        told = structurally_independent(chain, others, kinds, extra)
        held = [longest, *(name for name in shown if name not in (*told, longest))]
    return told, tuple(held)


def growth(
    chain: Chain,
    names: Sequence[str],
    lengths: Mapping[str, float],
    ends: tuple[str, str],
    joints: FloatArray,
    oriented: bool,
) -> FloatArray:
    """Return the growth (P,) of named parameters as `lengths` [m] of a chain grow.

    What is none of them shows in others, by poses or positions between the ends at (N, n).
    """
    changes, _, _ = followed(chain, names, [*lengths], joints, float(oriented), ends)
    return np.asarray(changes @ [*lengths.values()])


def followed(
    chain: Chain,
    names: Sequence[str],
    others: Sequence[str],
    joints: FloatArray,
    lever: float,
    ends: tuple[str, str] = ('base', 'tool'),
    approach: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how P named parameters follow a unit of each of K others.

    Their changes (P, K) are those that move the arm most nearly as the others do, at joint values
    (N, n), to which it came with signs of `approach` (N, n); a radian counts as `lever` [m]. What
    the others move (6 N, K) [m], and what is left of that, follow.
    """
    every = list(dict.fromkeys([*names, *others]))
    rows = ErrorModel(chain, every, *ends).jacobian(joints, approach)
    rows[:, 3:] *= lever
    flat = rows.reshape(-1, len(every))
    own, wanted = flat[:, : len(names)], flat[:, [every.index(name) for name in others]]
    scale = np.linalg.norm(own, axis=0)
    scale[scale <= ROUNDING * scale.max(initial=0.0)] = 1.0  # what moves nothing
    found = np.linalg.lstsq(own / scale, wanted, rcond=1e-9)[0] / scale[:, np.newaxis]
    return found, wanted, wanted - own @ found


def _meeting(chain: Chain, joints: FloatArray, kind: Kind) -> tuple[FloatArray, FloatArray]:
    """Return joint values (M, n) that bring the target to one place, and that place (3,) [m].

    It is that of the first, of planes the height in the middle. Those that have not arrived in 20
    steps, stretched, are left out.
    """
    places = chain.forward(joints, base=kind.base, tool=kind.tool)
    place = places[0, :3, 3].copy()
    if kind.plane:
        place[:] = 0.0, 0.0, np.median(places[:, 2, 3])
    places[:, :3, 3] = place
    part = slice(2, 3) if kind.plane else slice(3)
    found = solve(chain, places, joints, kind.base, kind.tool, part, 20)
    return found.joints[found.converged], place


def covariance(factor: FloatArray, middle: FloatArray | None = None) -> FloatArray:
    """Return the covariance (P, P) of the parameters from R, for weights in units of sigma.

    For Gaussian noise of those sigmas (R^T R)^-1 is the Cramer-Rao bound. With noise of another
    size it is (R^T R)^-1 M (R^T R)^-1, where `middle` M (P, P) is the normal matrix with every
    equation weighted by its true variance (in units of the one assumed).
    """
    scale = 1.0 / np.linalg.norm(factor, axis=0)
    inverse, failed = lapack.dtrtri(factor * scale)
    if failed:
        raise np.linalg.LinAlgError('singular factor')
    inverse *= scale[:, np.newaxis]
    if middle is None:
        return np.asarray(inverse @ inverse.T)
    sizes, directions = np.linalg.eigh(inverse.T @ middle @ inverse)
    root = inverse @ (directions * np.sqrt(np.maximum(sizes, 0.0)))  # no rounding below zero
    return np.asarray(root @ root.T)


@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty(Shown):
    """Covariance of the fitted parameters, by source of error.

    `parts` (K, P, P) are the shares of position, orientation, and what was known before; `freedom`
    (K,) the degrees of freedom from which the size of each was estimated, infinite where known.
    """

    parts: FloatArray
    freedom: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """Return the covariance (P, P) by all sources."""
        return np.asarray(self.parts.sum(axis=0))

    @property
    def overall(self) -> float:
        """Return the degrees of freedom of all parameters together."""
        variances = np.einsum('kpp,pp->k', self.parts, np.diag(1.0 / np.diag(self.covariance)))
        return float(self.freedom_of(variances))

    def freedom_of(self, variances: FloatArray) -> FloatArray:
        """Return the degrees of freedom (...) of a sum of variances (K, ...) from the sources.

        That of Satterthwaite (1946): the spread of the sum is that of a single estimate.
        """
        shares = variances / np.maximum(variances.sum(axis=0), 1e-300)
        with np.errstate(divide='ignore'):
            return np.asarray(1.0 / np.tensordot(1.0 / self.freedom, shares**2, axes=1))


def trades(matrix: FloatArray, names: Sequence[str], kept: Sequence[str]) -> dict[str, list[str]]:
    """Return, for each parameter that was left out, the fitted ones that it trades against.

    Moving the one, and the others by the right amounts, leaves every measured pose as it is.
    `matrix` (P, P) is the normal matrix of all of them.
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


@dataclass(frozen=True)
class Observability:
    """Observability indices of a set of poses from the singular values of the scaled Jacobian.

    O1 Borm and Menq 1991, O2 Driels and Pathre 1990, O3 and O4 Nahvi et al. 1994 and 1996,
    O5 Sun and Hollerbach 2008. Columns are in sigma of the measurement per metre or radian.
    """

    o1: float
    o2: float
    o3: float
    o4: float
    o5: float


def observability(factor: FloatArray, poses: int) -> Observability:
    """Return the indices from R (P, P) of the weighted Jacobian of a number of poses."""
    singular = np.asarray(np.linalg.svd(factor, compute_uv=False), dtype=float)
    mean = float(np.exp(np.log(np.maximum(singular, 1e-300)).mean()))
    return Observability(mean / np.sqrt(poses), *map(float, indices_of(singular).values()))


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
    """Return pairs of parameters whose correlation exceeds a threshold, strongest first.

    By their covariance (P, P).
    """
    std = np.sqrt(np.diag(matrix))
    correlation = matrix / np.outer(std, std)
    strong = np.argwhere(np.triu(np.abs(correlation) > threshold, 1)).tolist()
    pairs = [(names[i], names[j], float(correlation[i, j])) for i, j in strong]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair[2])))
