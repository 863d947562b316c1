# SPDX-License-Identifier: Apache-2.0
"""Makes a map of one recording, then localizes another one in it:

python examples/map_then_localize.py RECORDING OTHER MAP.dpm2map

Prints stamp (ns) and position in the map (m) of each frame of OTHER whose place is known. The map file must not exist
yet; localization leaves it as it is.
"""

import sys
from pathlib import Path

from dpm2_core import (
    Config,
    LocalizationSystem,
    SlamSystem,
    dump_settings,
    open_for_localization,
    open_session,
    open_source,
)

recording, other, map_file = sys.argv[1], sys.argv[2], Path(sys.argv[3])
config = Config()

with open_session(map_file, config.slam, dump_settings(config), resume=False) as store:
    slam = SlamSystem(config.slam, store=store)
    for frame in open_source(recording).frames():
        slam.process(frame)
    slam.mapper.finish()
    print(f"{map_file}: {len(slam.mapper.keyframes)} keyframes", file=sys.stderr)

with open_for_localization(map_file, config.slam) as store:
    system = LocalizationSystem(config.slam, store)
    for frame in open_source(other).frames():
        odometry, _ = system.process(frame)
        if system.localizer.state.located:
            T_map_lidar = system.localizer.T_map_odom @ odometry.T_odom_lidar
            print(frame.stamp, *T_map_lidar[:3, 3].round(3))
