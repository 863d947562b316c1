# SPDX-License-Identifier: Apache-2.0
"""Builds a map from one recording, then localizes another recording in it:

python examples/map_then_localize.py RECORDING OTHER MAP.dpm2map

Prints the stamp (ns) and the position in the map (m) of each frame of OTHER whose place is known. The map file must not
exist yet; localization does not change it.
"""

import sys
from pathlib import Path

from dpm2_core import (
    Config,
    dump_settings,
    make_slam,
    open_for_localization,
    open_session,
    open_source,
)

recording, other, map_file = sys.argv[1], sys.argv[2], Path(sys.argv[3])
config = Config()

with open_session(map_file, config.slam, dump_settings(config), resume=False) as store:
    slam = make_slam(config.slam, store=store)
    for frame in open_source(recording).frames():
        slam.process(frame)
    slam.finish()
    print(f"{map_file}: {len(slam.mapper.keyframes)} keyframes", file=sys.stderr)

with open_for_localization(map_file, config.slam) as store:
    slam = make_slam(config.slam, store=store)
    for frame in open_source(other).frames():
        T_map_lidar = slam.process(frame).T_map_lidar
        if T_map_lidar is not None:
            print(frame.stamp, *T_map_lidar[:3, 3].round(3))
