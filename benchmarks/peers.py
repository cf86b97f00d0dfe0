# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Identify the same arm with other programs, side by side in one run: time, memory and error.

    python benchmarks/peers.py [--poses 50 500 ...] [--kinds position pose] [--limit 300]
                               [--figure docs/speed.png] [--environments FOLDER] [--quick] [--json]

A simulated UR10e with errors of 0.5 mm and 1 mrad (noise 0.05 mm, 0.2 mrad) is identified to
convergence, each time in a process of its own (`solvers.py`):

    calib_ros      the whole of `identify`: frames without a guess, rank, gross errors, covariance
    fit            our least squares alone
    streamed       the same on samples that are read from the disk, a few at a time
    one by one     the same, one sample at a time
    scipy          scipy.optimize.least_squares with our analytic Jacobian, vectorised
    pybotics, figaroh, robotkinecal    from PyPI, as their documentation shows

All but the first start with the frames of the nominal arm fitted for free, and with a model
without gauge freedoms where they do not find it themselves. The error is the RMS of positions
predicted at 300 configurations that nobody saw. All run on one core (a second one slowed all of
them down where it was not idle); times are the shortest of several for fast programs. A program
that exceeds the limit [s], or is expected to, is not tried with more poses. The three from PyPI
get environments of their own in the folder named; `--quick` uses those that are there.
"""

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import venv
from dataclasses import replace
from datetime import date
from importlib.metadata import version
from pathlib import Path

import bench
import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.estimation.problem import Problem
from calib_ros.files.export import converted
from calib_ros.identification.identification import identify
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.chain_file import dump_chain, load_chain

PACKAGES = {
    'pybotics': '3.1.2',
    'figaroh': '1.0.2',
    'robotkinecal': '0.1.0',
    'mcap-ros2-support': '0.6.0',
}
PEERS = ('pybotics', 'figaroh', 'robotkinecal')
OURS = ('calib_ros', 'fit', 'streamed', 'one by one', 'scipy')
NOISE = (5e-5, 2e-4)
CACHE = Path(os.environ.get('XDG_CACHE_HOME', '~/.cache')).expanduser() / 'calib_ros_peers'
KINDS = ('position', 'pose')


def environment(folder, name, make):
    """Return the Python of an environment with a package from PyPI; make it if that is asked for.

    None where there is none.
    """
    place = folder / name
    python = place / 'bin' / 'python'
    if not python.exists():
        if not make:
            return None
        print(f'making {place}', file=sys.stderr)
        venv.create(place, with_pip=True)
        package = f'{name}=={PACKAGES[name]}'
        subprocess.run([python, '-m', 'pip', 'install', '--quiet', package], check=True)
    return python


def write_problem(folder, count, oriented, rng):
    """Write what the solvers get; return the true positions at the unseen joint values."""
    nominal = load_chain('ur10e')
    true = faulty(nominal, Cell(), rng)
    unseen = nominal.random_joints(300, rng)
    judge = measure(true, unseen, rng)
    seen = measure(true, nominal.random_joints(count, rng), rng, *NOISE)
    few = measure(true, nominal.random_joints(500, rng), rng, *NOISE, oriented=oriented)
    known = identify(Problem(nominal, few, held_out=judge))
    start = known.before
    for name, each in (('samples', seen), ('judge', judge)):
        parts = (each.joints, each.positions, each.rotations.reshape(-1, 9))
        np.hstack(parts).tofile(folder / f'{name}.bin')
    np.save(folder / 'unseen.npy', unseen)
    modified = converted(start, 'modified')
    facts = {
        'poses': count,
        'oriented': oriented,
        'names': known.names,
        'sigmas': NOISE,
        'joint_names': nominal.joint_names,
        'base': start.frame('base').matrix.tolist(),
        'modified_dh': [[j.alpha, j.a, j.theta, j.d] for j in modified.joints],
        'modified_tool': modified.frame('tool').matrix.tolist(),
    }
    (folder / 'facts.json').write_text(json.dumps(facts))
    (folder / 'start.yaml').write_text(dump_chain(start))
    (folder / 'start.urdf').write_text(urdf(start))
    return judge.positions


def urdf(chain):
    """Return a chain with its frames `base` and `tool` as a URDF; the last link is `target`."""
    nothing = np.zeros((1, len(chain.joints)))
    bare = converted(replace(chain, base=Frame(), tool=Frame()), 'modified')
    origins = [chain.frame('base').matrix]  # of each joint in the link before, at zero
    for joint in bare.joints:
        single = Chain('one', 'modified', (joint,), parallel=())
        origins.append(single.forward(nothing[:, :1])[0])
    origins.append(bare.frame('tool').matrix @ chain.frame('tool').matrix)
    names = ['base_fixed', *chain.joint_names, 'target_fixed']
    links = ['world', *(f'{name}_link' for name in names[:-1]), 'target']
    text = '<robot name="arm">\n' + ''.join(f'<link name="{name}"/>\n' for name in links)
    for k, (name, origin) in enumerate(zip(names, origins, strict=True)):
        xyz = ' '.join(map(repr, origin[:3, 3].tolist()))
        rpy = ' '.join(map(repr, Rotation.from_matrix(origin[:3, :3]).as_euler('xyz').tolist()))
        kind = 'fixed' if name.endswith('_fixed') else 'revolute'
        text += f'<joint name="{name}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/>'
        text += f'<parent link="{links[k]}"/><child link="{links[k + 1]}"/><axis xyz="0 0 1"/>'
        text += '<limit lower="-6.3" upper="6.3" effort="1" velocity="1"/></joint>\n'
    return text + '</robot>\n'


def run(python, name, folder, times, limit):
    """Let a solver solve the problem in a folder; return what it took, None beyond the limit."""
    variables = dict(os.environ, PYTHONPATH=str(Path(__file__).parents[1]))
    command = [python, Path(__file__).with_name('solvers.py'), name, folder, str(times)]
    try:
        done = subprocess.run(
            command,
            env=variables,
            capture_output=True,
            text=True,
            timeout=limit * times,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return None
    if done.returncode:
        raise RuntimeError(f'{name} failed:\n{done.stderr}')
    return json.loads(done.stdout.splitlines()[-1])


def compare(options):
    """Run all solvers; return their figures by kind, name and number of poses."""
    pythons = dict.fromkeys(OURS, sys.executable)
    for name in PEERS:
        python = environment(options.environments, name, not options.quick)
        if python is not None:
            pythons[name] = python
    found = {}
    for kind in options.kinds:
        last = {}
        for count in options.poses:
            rng = np.random.default_rng(0)
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                truth = write_problem(folder, count, kind == 'pose', rng)
                for name, python in pythons.items():
                    if name == 'pybotics' and kind == 'pose':
                        continue  # it knows positions only
                    before = last.get(name, (1, 0.0))
                    if before is None or before[1] * count / before[0] > 2.0 * options.limit:
                        continue
                    peer = name in PEERS or (name == 'one by one' and count > 50)
                    times = 1 if peer else 20 if count <= 500 else 5 if count <= 5000 else 2
                    figures = run(python, name, folder, times, options.limit)
                    took = 'too long' if figures is None else f'{figures["seconds"]:.3g} s'
                    print(f'{kind}, {count} poses, {name}: {took}', file=sys.stderr, flush=True)
                    last[name] = None if figures is None else (count, figures['seconds'])
                    if figures is None:
                        continue
                    left = np.load(folder / 'predicted.npy') - truth
                    figures['rms_um'] = 1e6 * float(np.sqrt((left**2).sum(axis=1).mean()))
                    found.setdefault(kind, {}).setdefault(name, {})[count] = figures
    return found


def judged(found):
    """Return the ratios that matter, and how time and memory grow with the poses."""
    figures = {}
    for kind, by_name in found.items():
        for name, by_count in by_name.items():
            for ours in ('calib_ros', 'fit'):
                if ours in by_name and name not in ('calib_ros', 'fit', 'streamed'):
                    ratios = {
                        n: each['seconds'] / by_name[ours][n]['seconds']
                        for n, each in by_count.items()
                        if n in by_name[ours]
                    }
                    figures[f'{kind}: {name} / {ours}'] = ratios
        for name in ('calib_ros', 'fit', 'streamed'):
            counts = np.array([n for n in by_name.get(name, ()) if n >= 500])
            if len(counts) > 1:
                times = [by_name[name][n]['seconds'] for n in counts]
                slope = float(np.polyfit(np.log(counts), np.log(times), 1)[0])
                figures[f'{kind}: growth of {name}'] = slope
    return figures


def table(found):
    """Return the figures as tables."""
    lines = []
    for kind, by_name in found.items():
        counts = sorted({n for each in by_name.values() for n in each})
        lines += [
            f'\n{kind}: wall time, CPU time, peak memory, error on unseen poses\n',
            '| | ' + ' | '.join(f'{n:,} poses' for n in counts) + ' |',
            '|---' * (len(counts) + 1) + '|',
        ]
        for name, by_count in by_name.items():
            cells = []
            for n in counts:
                each = by_count.get(n)
                cells.append('-' if each is None else _cell(each))
            lines.append(f'| {name} | ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines)


def _cell(each):
    wall, cpu = (
        f'{1e3 * t:.3g} ms' if t < 1.0 else f'{t:.3g} s' for t in (each['seconds'], each['cpu'])
    )
    return f'**{wall}**, {cpu}, {each["peak_mb"]:.0f} MB, {each["rms_um"]:.3g} µm'


def draw(found, path):
    """Draw wall time over the number of poses."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(found), figsize=(5.0 * len(found), 4.0), squeeze=False)
    for place, (kind, by_name) in zip(axes[0], found.items(), strict=True):
        for k, name in enumerate((*OURS, *PEERS)):
            by_count = by_name.get(name, {})
            mine = name in ('calib_ros', 'fit', 'streamed')
            times = [each['seconds'] for each in by_count.values()]
            style = f'C{k}o-' if mine else f'C{k}s--'
            place.loglog(list(by_count), times, style, ms=4, lw=2.0 if mine else 1.0, label=name)
        place.set(xlabel='poses', ylabel='wall time [s]', title=kind)
        place.grid(alpha=0.3)
    axes[0, -1].legend(fontsize=8, loc='center left', bbox_to_anchor=(1.0, 0.5))
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def cpu(run, times=1):
    """Return the least CPU time [s] of some runs."""
    best = np.inf
    for _ in range(times):
        begin = time.process_time()
        run()
        best = min(best, time.process_time() - begin)
    return best


def machine():
    """Return on what this runs, in words."""
    ours = ', '.join(f'{name} {version(name)}' for name in ('numpy', 'scipy'))
    theirs = ', '.join(f'{name} {number}' for name, number in PACKAGES.items())
    return (
        f'{os.cpu_count()} cores {platform.machine()}, Python {platform.python_version()}, '
        f'{ours}, {theirs}, {date.today().isoformat()}'
    )


def main():
    """Run the comparison and print it."""
    options = bench.options(
        __doc__,
        poses={'type': int, 'nargs': '+', 'default': [50, 500, 5000, 50000, 500000]},
        kinds={'nargs': '+', 'choices': KINDS, 'default': KINDS},
        limit=300.0,
        figure={'type': Path},
        environments=CACHE,
        quick=False,
        json=False,
    )
    if options.quick:
        options.poses, options.limit = [50, 500], 5.0
    found = compare(options)
    if options.figure:
        draw(found, options.figure)
    if options.json:
        print(
            json.dumps({'machine': machine(), 'figures': found, 'judged': judged(found)}, indent=1)
        )
        return
    print(machine())
    print(table(found))
    for name, value in judged(found).items():
        if isinstance(value, float):
            print(f'{name}: time ~ poses ** {value:.2f}')
        else:
            print(f'{name}: ' + ', '.join(f'{ratio:.3g} x at {n:,}' for n, ratio in value.items()))


if __name__ == '__main__':
    main()
