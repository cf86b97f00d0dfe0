# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures of a report for plotly: plain dictionaries of `data` and `layout`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from scipy import special

from calib_ros.apply.workspace import Survey, rms_map
from calib_ros.estimation.fitted import ParameterRow
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.joint import Joint
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.report.poses import Poses, numbers, unit_of
from calib_ros.shown import LISTED
from calib_ros.texts import one_line

Figure: TypeAlias = dict[str, Any]
BEFORE, AFTER, LIMIT = '#d95f02', '#1b9e77', '#6e7781'
DASHED, SOLID = {'color': BEFORE, 'dash': 'dash'}, {'color': AFTER, 'dash': 'solid'}
DOTTED = {'color': LIMIT, 'dash': 'dot'}
AROUND_ZERO = [[0.0, '#053061'], [0.5, '#ffffff'], [1.0, '#67001f']]
QUANTILES = 2 * SOME_POSES  # points of a curve for any number of poses
TICKS = {'tickvals': [m * 10.0**k for k in range(-6, 4) for m in (1, 2, 5)], 'tickformat': '~g'}
"""Of a logarithmic axis: 0.1, 0.2, 0.5, 1, ..."""
REVERSED = {'autorange': 'reversed', 'automargin': True}
"""Vertical axis with the first row on top."""
ROUND = ('eccentricity', 'gear')  # periodic groups of effects


def label(name: str) -> str:
    """Return a foreign name without the tags that plotly interprets."""
    return one_line(name).replace('&', '&amp;').replace('<', '&lt;')


def axis(title: str, **more: Any) -> Figure:
    """Return an axis, or a colour scale, with its title."""
    return {'title': {'text': title}, **more}


def scale_of(title: str, colours: Any = 'Viridis', **more: Any) -> Figure:
    """Return a colour scale beside the figure."""
    bar = axis(title, thickness=12)
    return {'colorscale': colours, 'reversescale': True, 'colorbar': bar, **more}


def _margin(left: int, top: int, bottom: int) -> dict[str, int]:
    return {'l': left, 'r': 16, 't': top, 'b': bottom}


def _heat_map(x: list[Any], y: list[Any], z: list[Any], hover: str, look: Figure) -> Figure:
    hover += '<extra></extra>'
    return {'type': 'heatmap', 'x': x, 'y': y, 'z': z, 'hovertemplate': hover, **look}


def _curve(mode: str, name: str, x: FloatArray, y: FloatArray, **more: Any) -> Figure:
    points = {'x': numbers(x), 'y': numbers(y)}
    return {'type': 'scatter', 'mode': mode, 'name': name, **points, **more}


def cumulated(before_mm: FloatArray, after_mm: FloatArray, things: str) -> Figure:
    """Return the share of poses, or other `things`, with at most a given position error (N,)."""
    count, points = len(before_mm), min(QUANTILES, len(before_mm))
    rank = (np.arange(1, points + 1) * count - 1) // points
    share = 100.0 * np.append(0, rank + 1) / count
    data = [
        _curve(
            'lines', name, np.sort(errors)[np.append(0, rank)], share, line=line | {'shape': 'hv'}
        )
        for name, errors, line in (('before', before_mm, DASHED), ('after', after_mm, SOLID))
    ]
    most = float(max(before_mm.max(initial=0.0), after_mm.max(initial=0.0)))
    across = axis('position error [mm]', range=[0, 1.02 * most or 1.0])
    up = axis(f'{things} with at most this error [%]', range=[0, 100])
    return {'data': data, 'layout': {'xaxis': across, 'yaxis': up}}


def against_noise(poses: Poses) -> Figure:
    """Return the quantiles of residuals in stated sigmas against those of a normal law."""
    position, orientation = np.split(poses.in_sigma[poses.judged], 2, axis=1)
    data: list[Figure] = []
    for name, errors, colour, symbol in (
        ('position', position, AFTER, 'circle'),
        ('orientation', orientation, '#7570b3', 'diamond'),
    ):
        z = errors[np.isfinite(errors)]
        if not z.size:
            continue
        count = min(QUANTILES, z.size)
        share = (np.arange(count) + 0.5) / count
        marker = {'color': colour, 'symbol': symbol, 'size': 5}
        x, y = special.ndtri(share), np.quantile(z, share)
        data.append(_curve('markers', name, x, y, marker=marker))
    ends = np.array([-3.0, 3.0])
    data.append(_curve('lines', 'noise as assumed', ends, ends, line=DOTTED))
    across, up = axis('expected from pure noise'), axis('measured [times the assumed noise]')
    return {'data': data, 'layout': {'xaxis': across, 'yaxis': up}}


def forest(parameters: Sequence[ParameterRow], lengths: bool, limit: float) -> Figure | None:
    """Return offsets with 95 % intervals [mm or mrad], and a `limit` [m or rad] if near."""
    found = [p for p in parameters if p.std is not None and p.name.is_length == lengths]
    if not found:
        return None
    unit = 'mm' if lengths else 'mrad'
    offsets = 1e3 * np.array([p.offset for p in found])
    widths = 1e3 * np.array([p.half_width() or 0.0 for p in found])
    reach = 1.1 * float(np.max(np.abs(offsets) + widths, initial=1e-3))
    dots = {
        'type': 'scatter',
        'mode': 'markers',
        'name': 'offset and 95 % interval',
        'x': numbers(offsets),
        'y': [label(p.name) for p in found],
        'error_x': {'type': 'data', 'array': numbers(widths), 'color': AFTER, 'thickness': 2},
        'marker': {'color': AFTER, 'size': 8},
        'hovertemplate': f'%{{y}}: %{{x:.4f}} {unit}<extra></extra>',
    }
    lines = [{'x0': 0.0, 'x1': 0.0, 'line': {'color': LIMIT, 'width': 1}}]
    if 1e3 * limit < 3.0 * reach:
        reach = max(reach, 1.1e3 * limit)
        edge = {'color': '#b3261e', 'width': 2, 'dash': 'dash'}
        lines += [{'x0': x, 'x1': x, 'line': edge} for x in (-1e3 * limit, 1e3 * limit)]
    shape = {'type': 'line', 'yref': 'paper', 'y0': 0, 'y1': 1}
    layout = {
        'xaxis': axis(f'offset [{unit}]', range=[-reach, reach]),
        'yaxis': REVERSED,
        'shapes': [shape | each for each in lines],
        'margin': _margin(170, 30, 50),
        'showlegend': True,
    }
    return {'data': [dots], 'layout': layout}


def correlations(names: Sequence[str], covariance: FloatArray) -> Figure:
    """Return the correlations of fitted parameters (P, P) as a heat map."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    labels = list(map(label, names))
    values = numbers(covariance / np.outer(scale, scale), 3)
    colours = scale_of('correlation', AROUND_ZERO, zmin=-1, zmax=1)
    mesh = _heat_map(labels, labels, values, '%{y} and %{x}: %{z:.2f}', colours)
    small = {'tickfont': {'size': 10}, 'automargin': True}
    layout = {'xaxis': small, 'yaxis': REVERSED | small, 'margin': _margin(130, 20, 90)}
    return {'data': [mesh], 'layout': layout}


def histogram(
    chain: Chain, joints: FloatArray, parts: int = 36
) -> tuple[Figure, tuple[tuple[str, ...], ...]]:
    """Return how often joint values (N, n) fall in each part of a joint's range, and a table."""
    counts = np.zeros((len(chain.joints), parts))
    labels, rows = [], []
    for k, joint in enumerate(chain.joints):
        lower, upper = joint.range
        low, high = float(joints[:, k].min()), float(joints[:, k].max())
        free = joint.lower is None and joint.upper is None
        if free and not (lower <= low and high <= upper):  # a turn from the lowest value
            lower, upper = low, low + upper - lower
        lower, upper = min(lower, low), max(upper, high)
        counts[k] = np.histogram(joints[:, k], parts, (lower, upper))[0]
        ends = _span(joint, lower, upper, 0) + ' (no limits)' * free
        labels.append(f'{label(joint.name)}<br>{ends}')
        share = 100.0 * float(np.mean(counts[k] > 0))
        rows.append((joint.name, ends, _span(joint, low, high), f'{share:.0f} %'))
    x = numbers(100.0 * (np.arange(parts) + 0.5) / parts, 4)
    z = numbers(np.where(counts > 0, counts, np.nan))
    look = scale_of('poses')
    look['colorbar'] |= {'dtick': 1} if counts.max() < LISTED else {}  # whole numbers
    mesh = _heat_map(x, labels, z, '%{y}<br>%{z} poses', look)
    across = axis('position in the joint range [%]', range=[0, 100])
    layout = {'xaxis': across, 'yaxis': REVERSED, 'margin': _margin(130, 20, 50)}
    return {'data': [mesh], 'layout': layout}, tuple(rows)


def _span(joint: Joint, low: float, high: float, digits: int | None = None) -> str:
    """Return two joint values [rad, m] as text with their unit, zero without a sign."""
    factor, unit, usual = unit_of(joint)
    digits = usual if digits is None else digits
    ends = (f'{round(factor * value, digits) + 0.0:.{digits}f}' for value in (low, high))
    return ' to '.join(ends) + (unit if unit == '°' else f' {unit}')


def drives(chain: Chain, joints: FloatArray) -> Figure | None:
    """Return the errors of drives over the range of joint values (N, n); None without any."""
    waves = [each for each in chain.effects if effects.group_of(each[0]) in ROUND]
    owners = np.array([Parameter(name).owner for name, _ in waves])
    driven = [k for k, name in enumerate(chain.joint_names) if name in owners]
    if not driven:
        return None
    low, high = joints[:, driven].min(axis=0), joints[:, driven].max(axis=0)
    q = np.linspace(low.min(), high.max(), 720)
    phi = effects.basis(chain, [name for name, _ in waves], np.tile(q, (len(joints.T), 1)), None)
    added = 1e3 * np.array([value for _, value in waves])[:, np.newaxis] * phi
    names = [chain.joint_names[k] for k in driven]
    error = np.array([added[owners == name].sum(axis=0) for name in names])
    error[(q < low[:, np.newaxis]) | (q > high[:, np.newaxis])] = np.nan
    largest = float(np.nanmax(np.abs(error)))
    colours = scale_of('mrad', AROUND_ZERO, zmin=-largest, zmax=largest)
    x, y, z = numbers(np.degrees(q)), list(map(label, names)), numbers(error, 3)
    mesh = _heat_map(x, y, z, '%{y} at %{x}°: %{z:.3f} mrad', colours)
    across = axis('joint value [°]')
    layout = {'xaxis': across, 'yaxis': REVERSED, 'margin': _margin(130, 20, 50)}
    return {'data': [mesh], 'layout': layout}


def error_map(survey: Survey) -> Figure:
    """Return the RMS of removed and remaining errors by radius and height."""
    x, y, z = survey.positions.T
    parts = dict(list(survey.parts.items())[::2])  # without sigma
    largest = 1e3 * max(float(np.quantile(errors, 0.99)) for errors in parts.values())
    data: list[Figure] = []
    layout: Figure = {'grid': {'rows': 1, 'columns': len(parts), 'pattern': 'independent'}}
    layout['annotations'] = []
    for k, (label, errors) in enumerate(parts.items()):
        end = str(k + 1) if k else ''
        radius, height, rms = rms_map(np.hypot(x, y), z, 1e3 * errors)
        across, up = (numbers(0.5 * (edges[1:] + edges[:-1])) for edges in (radius, height))
        look = scale_of('RMS [mm]', zmin=0, zmax=largest, showscale=k == 0)
        look |= {'xaxis': f'x{end}', 'yaxis': f'y{end}'}
        hover = 'radius %{x:.2f} m, height %{y:.2f} m: %{z} mm'
        data.append(_heat_map(across, up, numbers(rms.T, 3), hover, look))
        title = {'text': label.removesuffix(' by the calibration'), 'showarrow': False}
        place = {'xref': f'x{end} domain', 'yref': 'paper', 'x': 0, 'y': 1, 'yanchor': 'bottom'}
        layout['annotations'].append(title | place)
        layout[f'xaxis{end}'] = axis('radius [m]')
        layout[f'yaxis{end}'] = {'showticklabels': False} if k else axis('height [m]')
    layout['margin'] = _margin(60, 30, 50)
    return {'data': data, 'layout': layout}


def predictions(accuracy: FloatArray, at_random: FloatArray, wanted_mm: float | None) -> Figure:
    """Return the predicted errors (K,) [m] of 1, 2, ... K planned poses, and of random ones."""
    count = np.arange(1.0, len(accuracy) + 1)
    data = []
    for name, errors, line in (('planned', accuracy, SOLID), ('at random', at_random, DASHED)):
        known = np.isfinite(errors)
        data.append(_curve('lines+markers', name, count[known], 1e3 * errors[known], line=line))
    if wanted_mm is not None:
        data.append(_curve('lines', 'wanted', count[[0, -1]], np.full(2, wanted_mm), line=DOTTED))
    up = axis('predicted RMS error [mm]', type='log', **TICKS)
    return {'data': data, 'layout': {'xaxis': axis('poses measured'), 'yaxis': up}}


def in_space(positions: FloatArray, name: str, **more: Any) -> Figure:
    """Return points (N, 3) [m] in space."""
    x, y, z = (numbers(each) for each in positions.T)
    return {'type': 'scatter3d', 'mode': 'markers', 'x': x, 'y': y, 'z': z, 'name': name, **more}


def space(*data: Figure) -> Figure:
    """Return a figure in space with equal scales."""
    axes = {f'{name}axis': axis(f'{name} [m]') for name in 'xyz'}
    margin = {'l': 0, 'r': 0, 't': 30, 'b': 0}
    look = {'eye': {'x': 1.9, 'y': -1.3, 'z': 0.8}, 'center': {'x': 0, 'y': 0, 'z': -0.15}}
    layout = {'scene': {'aspectmode': 'data', 'camera': look, **axes}, 'margin': margin}
    return {'data': list(data), 'layout': layout}
