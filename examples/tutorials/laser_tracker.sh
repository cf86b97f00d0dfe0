#!/bin/sh
# From docs/tutorials/laser_tracker.md, by extract.py.
set -e
python3 - <<'END'
import numpy as np
from calib_ros import load_chain
from calib_ros.apply.simulation import Cell, faulty

rng = np.random.default_rng(3)
true = faulty(load_chain('staubli_tx90l'), Cell(), rng)  # the real arm, in place of yours
joints = true.random_joints(50, rng)
positions = true.forward(joints)[:, :3, 3] + rng.normal(scale=2e-5, size=(50, 3))
with open('measured.csv', 'w') as file:
    file.write('q1,q2,q3,q4,q5,q6,x,y,z,split\n')
    for k, row in enumerate(np.column_stack([joints, positions])):
        numbers = ','.join(f'{value:.9f}' for value in row)
        file.write(f'{numbers},{"test" if k >= 40 else "train"}\n')
new = true.random_joints(12, rng)
rows = np.column_stack([new, true.forward(new)[:, :3, 3]])
head = 'q1,q2,q3,q4,q5,q6,x,y,z'
np.savetxt('new.csv', rows, delimiter=',', header=head, comments='', fmt='%.9f')
END
calib_ros identify measured.csv --chain staubli_tx90l --out result --tolerance 0.2 \
    --sigma-position 2e-5 --operator "A. Smith" --serial 4711 --device "AT960 12345" --pdf
calib_ros workspace result --chain staubli_tx90l --poses 500 --out map
calib_ros verify new.csv --chain staubli_tx90l --calibration result --new-base --tolerance 0.2 \
    --out verified
