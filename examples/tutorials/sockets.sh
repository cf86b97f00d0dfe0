#!/bin/sh
# From docs/tutorials/sockets.md, by extract.py.
set -e
python3 - <<'END'
import numpy as np
from calib_ros import load_chain
from calib_ros.apply.simulation import Cell, faulty
from calib_ros.kinematics.inverse import solve
from calib_ros.kinematics.se3 import exp_rotation, transform

rng = np.random.default_rng(1)
true = faulty(load_chain('ur10e'), Cell(), rng)  # the real arm, in place of yours
bar = np.array([0.05, 0.0, 0.0])
rows = []
for location in range(4):
    there = true.forward(true.random_joints(1, rng))[0]
    for socket in range(2):
        found = []
        while len(found) < 15:
            turns = exp_rotation(rng.normal(scale=0.7, size=(30, 3))) @ there[:3, :3]
            centre = there[:3, 3] + socket * bar + rng.normal(scale=2e-5, size=(30, 3))
            solved = solve(true, transform(turns, centre), true.random_joints(30, rng))
            found += solved.joints[solved.converged].tolist()
        rows += [[*joints, f'place{location}', socket] for joints in found[:15]]
with open('sockets.csv', 'w') as file:
    file.write('q1,q2,q3,q4,q5,q6,location,socket\n')
    for row in rows:
        file.write(','.join(map(str, row)) + '\n')
END
calib_ros identify sockets.csv --chain ur10e --socket-distance 0.05 --sigma-position 2e-5 \
    --out result
