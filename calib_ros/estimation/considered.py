# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Effects that an arm may have, and given values that may be off: considered, not fitted."""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence
from itertools import compress

import numpy as np

from calib_ros.estimation.levels import LARGEST_SCALE, OUT_OF_SCALE, PRINTED, SCALE
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.system import System
from calib_ros.estimation.visits import sided
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import IN_PIXELS, Parameter, parameters_of
from calib_ros.settings import Settings

CONSIDERED = ('eccentricity', 'gravity')
"""Effects that any arm may have, fitted or not; moves of one joint hardly excite couplings."""


def considered(
    chain: Chain,
    names: Sequence[str],
    fixed: Sequence[str] = (),
    sets: Sequence[Observations] = (),
) -> tuple[str, ...]:
    """Return the effects that an arm may have besides the named ones.

    DH parameters held at nominal by a `fixed` pattern may be off as well, and frames held by the
    chain file. Where eccentricity is fitted, waves of other orders look like it in part of a turn.
    Joints may have play, of which `sets` tell: of joints from both sides, or with stated signs.
    """
    every = [name for group in CONSIDERED for name in effects.members(chain, group)]
    every += effects.couplings([each.name for each in chain.joints if each.type == 'revolute'])
    every += travels(chain)
    if sets:
        stated = [each.approach.any(axis=0) for each in sets if each.approach is not None]
        signs = np.concatenate([each.approach for each in sided(sets)])
        known = np.any([signs.min(axis=0) * signs.max(axis=0) < 0.0, *stated], axis=0)
        every += compress(effects.members(chain, 'backlash'), known)
    fitted = [name for name in effects.members(chain, 'eccentricity') if name in names]
    for owner in dict.fromkeys(name.owner for name in fitted):
        every += [wave for order in (3, 4) for wave in effects.waves(owner, order)]
    held = {n for each in fixed for n in fnmatch.filter(chain.parameter_names, each)}
    every += [name for name in chain.parameter_names if name in held and name.of_dh]
    every += [*lenses(chain), *held_frames(chain)]
    return tuple(name for name in every if name not in names)


def travels(chain: Chain) -> list[Parameter]:
    """Return the ratios of linear joints: their travel may be out of scale."""
    return [Parameter(j.name, 'ratio') for j in chain.joints if j.type == 'prismatic']


def held_frames(chain: Chain) -> list[Parameter]:
    """Return the parameters of the frames that the chain file holds."""
    held = [key for key in chain.frame_names if chain.frame(key).fixed]
    return [name for key in held for name in parameters_of(key)]


def lenses(chain: Chain) -> dict[Parameter, float]:
    """Return the standard deviations [px] of given intrinsics: a calibration has errors too."""
    return {
        name: OUT_OF_SCALE * frame.lens.fx
        for key in chain.frame_names
        if (frame := chain.frame(key)).lens is not None and frame.lens.fixed
        for name in parameters_of(key, IN_PIXELS)
    }


def lengths_of(chain: Chain, system: System) -> tuple[Chain, dict[str, float], float]:
    """Return all lengths [m] that positions depend on, and the standard deviation of their scale.

    There are none for sockets and planes alone, whose places are fixed, unless a bar is between.
    The travel of a prismatic joint is scaled by its ratio, which is added to the returned chain.
    """
    sets = [samples.observations for samples in system.sets]
    sets = [each for each in sets if not (each.socket or each.plane)]
    if not (sets or system.separations):
        return chain, {}, SCALE
    chain = chain.with_effects(travels(chain))
    names: list[str] = [name for frame in chain.frame_names for name in parameters_of(frame)[:3]]
    names += [name for joint in chain.joints for name in joint.parameters if name.is_length]
    scale = SCALE
    if not sets:
        longest = max(distance for *_, distance in system.separations)
        scale = max(scale, Settings.sigma_position / longest)
    elif all(each.pixels is not None for each in sets):
        scale = PRINTED
    elif all(each.distances is not None for each in sets):
        scale = LARGEST_SCALE
    return chain, {n: chain.value(n) for n in names} | {str(n): 1.0 for n in travels(chain)}, scale
