#!/bin/sh
# From docs/tutorials/ur_mocap.md, by extract.py.
set -e
calib_ros plan --chain ur10e --poses 30 --draw 200 --out plan.csv
calib_ros simulate recording --chain ur10e --poses 30 --seed 1
calib_ros identify recording --chain ur10e --out result --device "motion capture" --tolerance 0.5
calib_ros export result/calibration.yaml --chain ur10e --out export
calib_ros plan --chain ur10e --iso9283 --out tests.csv
calib_ros compensate tests.csv --chain ur10e --calibration result --out corrected.csv
python3 - <<'END'
import numpy as np
from calib_ros import load_chain

true = load_chain('recording_truth.yaml')
corrected = np.loadtxt('corrected.csv', delimiter=',', skiprows=1)
joints = np.repeat(corrected, 3, axis=0)  # three cycles
positions = true.forward(joints)[:, :3, 3]
positions += np.random.default_rng(2).normal(scale=5e-5, size=positions.shape)
np.savetxt(
    'measured.csv',
    np.column_stack([joints, positions]),
    delimiter=',',
    header='q1,q2,q3,q4,q5,q6,x,y,z',
    comments='',
    fmt='%.9f',
)
END
calib_ros verify measured.csv --commanded tests.csv --chain ur10e --calibration result \
    --tolerance 0.5 --out verified
