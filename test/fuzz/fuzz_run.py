# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Look for inputs that break the contract of the readers.

    python test/fuzz/fuzz_run.py [--seconds 180] [--jobs 2] [--targets table,urdf] [--seed 0]

Each target runs in a process of its own: by atheris, which is led by the branches that an input
reaches, or, where there is no atheris for this Python, by random variants of the seeds.
What breaks the contract is kept in `test/fuzz/failures`; put it into `test/fuzz/corpus`
with its mend, and every test run replays it.
"""

import argparse
import hashlib
import importlib.util
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HERE = Path(__file__).parent
FAILURES = HERE / 'failures'
ADDRESS_SPACE = 6_000_000_000


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--seconds', type=float, default=180.0, help='for all targets together')
    parser.add_argument('--jobs', type=int, default=2)
    parser.add_argument('--targets', help='joined by commas; all if not given')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--one', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        return fuzz(options.one, options.seconds, options.seed)
    from fuzz_targets import TARGETS

    names = options.targets.split(',') if options.targets else list(TARGETS)
    each = options.seconds * options.jobs / len(names)

    def run(name):
        arguments = ['--one', name, '--seconds', f'{each:.0f}', '--seed', str(options.seed)]
        done = subprocess.run(
            [sys.executable, __file__, *arguments],
            capture_output=True,
            text=True,
            errors='replace',
        )
        words = (done.stdout + done.stderr).strip().split('\n')
        counts = [line for line in words if 'runs' in line or 'number_of_executed' in line]
        print(f'{name}: {"kept" if not done.returncode else "BROKEN"} {counts[-1:]}', flush=True)
        if done.returncode:
            print('\n'.join(words[-40:]), flush=True)
        return done.returncode

    with ThreadPoolExecutor(options.jobs) as pool:
        return int(any(list(pool.map(run, names))))


def fuzz(name, seconds, seed):
    """Run one target for some seconds; return 1 when the contract was broken."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    FAILURES.mkdir(exist_ok=True)
    led = importlib.util.find_spec('atheris') is not None
    return (by_atheris if led else by_chance)(name, seconds, seed)


def by_atheris(name, seconds, seed):
    import atheris

    with atheris.instrument_imports(include=['calib_ros', 'rosbags']):
        pass
    import fuzz_targets

    fuzz_targets.keep_contract(name, fuzz_targets.corpus(name)[0])  # imports what comes late
    folder = tempfile.mkdtemp()
    arguments = [f'-max_total_time={seconds:.0f}', f'-seed={seed + 1}', '-print_final_stats=1']
    arguments += ['-rss_limit_mb=0', '-timeout=60', '-max_len=65536', '-verbosity=1']
    arguments += [f'-artifact_prefix={FAILURES}/{name}-', '-use_value_profile=0']
    atheris.Setup(
        [sys.argv[0], *arguments, folder, str(fuzz_targets.CORPUS / name)],
        lambda data: fuzz_targets.keep_contract(name, data),
    )
    try:
        atheris.Fuzz()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def by_chance(name, seconds, seed):
    from fuzz_targets import corpus, keep_contract
    from fuzz_variants import variant

    rng, seeds = random.Random(seed), corpus(name)
    until, runs = time.monotonic() + seconds, 0
    while time.monotonic() < until:
        data = variant(rng, seeds)
        runs += 1
        try:
            keep_contract(name, data)
        except BaseException:
            digest = hashlib.sha256(data).hexdigest()[:12]
            (FAILURES / f'{name}-{digest}').write_bytes(data)
            raise
    print(f'{runs} runs')
    return 0


if __name__ == '__main__':
    sys.exit(main())
