# SPDX-License-Identifier: Apache-2.0
"""Registers one scan of a recording to another by the network, without an initial guess, and plots the matches:

python examples/register_two_scans.py RECORDING TARGET SOURCE OUT.png

TARGET and SOURCE are indices of scans in the recording, from 0. Needs the extra `plot`.
"""

import sys

from dpm2_core import load_network, matches_png, open_source

recording, at_target, at_source, out = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]

drive = open_source(recording)
(target,) = drive.frames(at_target, at_target + 1)
(source,) = drive.frames(at_source, at_source + 1)

network = load_network("small", threads=2)
of_target, of_source = network.describe(target), network.describe(source)
registration = network.register(of_source, of_target)
if not registration.ok:
    sys.exit(f"not registered: {registration.reason}")

x, y, z = registration.T_target_source[:3, 3]
print(f"the source is at {x:.2f} {y:.2f} {z:.2f} m in the frame of the target")
print(f"confidence {registration.confidence:.2f}, position to {registration.worst_sigma:.2f} m (1 sigma)")
matches_png(out, network, source, target)
