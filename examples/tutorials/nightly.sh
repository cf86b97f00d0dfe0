#!/bin/sh
# From docs/tutorials/nightly.md, by extract.py.
set -e
calib_ros simulate night/monday --chain ur10e --poses 20 --seed 1
calib_ros simulate night/tuesday --chain ur10e --poses 20 --seed 1
calib_ros identify night/monday --chain ur10e --out results/monday
python3 - <<'END'
import sys
from pathlib import Path

from calib_ros import CalibrationSession, identify, load_chain, replay

chain = load_chain('ur10e')
LARGEST = 0.2  # mm on poses that were not fitted

failed = []
for bag in sorted(each for each in Path('night').iterdir() if each.is_dir()):
    session = CalibrationSession(chain)
    print(bag.name, replay(bag, session))
    result = identify(session.problem())
    for refusal in result.refusals:
        failed.append(f'{bag.name}: {refusal}')
    after = (result.validation or result.fitted).figures[1].rms_mm
    if after > LARGEST:
        failed.append(f'{bag.name}: RMS {after:.3f} mm')
if failed:
    sys.exit('\n'.join(failed))
END
