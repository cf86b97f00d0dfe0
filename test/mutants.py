# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tell which changes of numeric modules no near test notices, one change at a time.

mutmut makes the changes (mutants) and runs the tests. This chooses both: a random sample of the
mutants of some modules, and for each module only the tests near it.
"""

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
from collections import Counter
from fnmatch import fnmatch
from itertools import groupby
from multiprocessing import Process
from pathlib import Path

from mutmut.__main__ import _run, collect_source_file_mutation_data, copy_src_dir, create_mutants
from mutmut.configuration import config
from mutmut.stats import status_by_exit_code

CHANGED = ('git', 'diff', '--name-only', '--diff-filter=d', 'HEAD~1', '--', 'calib_ros')
NONE = (
    'No numeric module or mutant is given, or was changed by the last commit and since: give '
    'modules or folders like calib_ros/kinematics, or names of mutants'
)


def modules_of(part):
    """Return the numeric modules of a file, a folder or a pattern of names of mutants."""
    path = Path(part)
    if not path.exists():
        path = Path(part.rpartition('.')[0].replace('.', '/') + '.py')
    found = sorted(path.glob('*.py')) if path.is_dir() else [path]
    return [str(path) for path in found if path.exists() and config().should_mutate(path)]


def imported(path):
    """Return the modules and names that a file imports from."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            found |= {node.module, *(f'{node.module}.{each.name}' for each in node.names)}
    return found


def near(module):
    """Yield the tests of its folder that import a module, then those of its importers, and so on.

    Without any, those of other folders that import it, or else all of its folder.
    """
    left = {path: imported(path) for path in Path('test', module.parts[1]).glob('test_*.py')}
    users = {path: imported(path) for path in module.parent.glob('*.py')}
    tests, ring, names = {*left}, {module}, {_name(module)}
    while ring:
        files = {f'test_{path.stem}.py' for path in ring}
        found = {path for path, each in left.items() if each & names or path.name in files}
        if found:
            yield sorted(map(str, found))
        left = {path: each for path, each in left.items() if path not in found}
        users = {path: each for path, each in users.items() if path not in ring}
        ring = {path for path, each in users.items() if each & names}
        names = {_name(path) for path in ring}
    if len(left) == len(tests):
        others = {p for p in Path('test').glob('*/test_*.py') if _name(module) in imported(p)}
        yield sorted(map(str, others or tests))


def _name(path):
    return '.'.join(path.with_suffix('').parts)


def chosen(parts, count, seed, jobs):
    """Write the mutants of `parts`; return the module and name of each of a random sample."""
    modules = sorted({module for part in parts for module in modules_of(part)})
    if not modules:
        sys.exit(NONE)
    config().only_mutate = modules
    shutil.rmtree('mutants', ignore_errors=True)
    copy_src_dir()
    create_mutants(jobs)
    written, _ = collect_source_file_mutation_data(mutant_names=())
    every = [(Path(data.path), name) for data, name, _ in written]
    whole = {module for part in parts if Path(part).exists() for module in modules_of(part)}
    named = [
        (module, name)
        for module, name in every
        if str(module) in whole or any(fnmatch(name, part) for part in parts)
    ]
    if not named:
        sys.exit(NONE)
    print(f'{min(count, len(named))} of {len(named)} mutants:', *modules, flush=True)
    return sorted(random.Random(seed).sample(named, min(count, len(named))))


def tried(module, names, jobs, further):
    """Run the tests near a module on its mutants; return the state of each by name.

    Those further away run only on mutants of functions that none of those before calls, and if
    `further` on all that lived.
    """
    left, states = names, {}
    again = ('no tests', 'not checked', *(['survived'] if further else []))
    for tests in near(module):
        Path('mutants/mutmut-stats.json').unlink(missing_ok=True)
        config().pytest_add_cli_args_test_selection = tests
        run = Process(target=_run, args=(left, jobs))  # of its own: modules are imported once
        run.start()
        run.join()
        ended, _ = collect_source_file_mutation_data(mutant_names=left)
        found = {name: status_by_exit_code[code] for _, name, code in ended}
        states |= {
            n: state for n, state in found.items() if state != 'no tests' or n not in states
        }
        left = [name for name in left if states[name] in again]
        if not left:
            break
    return states


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('parts', nargs='*', help='modules, folders or names of mutants')
    parser.add_argument('--count', type=int, default=40, help='mutants to try (default: 40)')
    parser.add_argument('--seed', type=int, default=0, help='of the random choice (default: 0)')
    parser.add_argument('--jobs', type=int, default=os.cpu_count())
    given = parser.parse_args()
    parts = given.parts or subprocess.check_output(CHANGED, text=True).split()
    pairs = chosen(parts, given.count, given.seed, given.jobs)
    states, further = {}, not all(Path(part).exists() for part in parts)
    for module, group in groupby(pairs, key=lambda pair: pair[0]):
        states |= tried(module, [name for _, name in group], given.jobs, further)
    print(*(f'{name}: {state}' for name, state in states.items() if state != 'killed'), sep='\n')
    counts = Counter(states.values())
    noticed = counts['killed'] + counts['timeout']
    print(', '.join(f'{count} {state}' for state, count in counts.most_common()))
    print(f'{noticed} of {len(states)} noticed ({noticed / len(states):.0%}), seed {given.seed}.')
    print(f'To see one: {Path(sys.executable).with_name("mutmut")} show NAME')


if __name__ == '__main__':
    main()
