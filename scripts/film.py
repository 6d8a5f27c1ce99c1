"""A run as an animated picture. Use: python scripts/film.py RUN WEBP, where RUN is a folder of
`headway run`, and WEBP the file to write.

The machine as `headway report` draws it, with its reference as a ghost; it plays in a loop.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from headway.cli.page.animation import Motion, scene_of
from headway.controller.record.reader import read_run

SCALE = 0.75  # of the report's pictures
QUALITY, EFFORT = 60, 6  # WebP

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("run", type=Path, help="folder of a run, or its run.mcap")
parser.add_argument("webp", type=Path, help="the file to write")
parser.add_argument("--begin", type=float, default=1.0, help="time of the task [s]")
parser.add_argument("--seconds", type=float, default=6.0, help="how long; best whole periods")
parser.add_argument("--fps", type=float, default=20.0, help="pictures a second")
options = parser.parse_args()

run = read_run(options.run)
motion = Motion(run, None)
times_s = options.begin + np.arange(round(options.seconds * options.fps)) / options.fps
with scene_of(run) as scene:
    pictures = [
        Image.fromarray(scene.picture(motion.pose(time_s), motion.ghost(time_s), SCALE))
        for time_s in times_s
    ]
options.webp.parent.mkdir(parents=True, exist_ok=True)
pictures[0].save(
    options.webp,
    save_all=True,
    append_images=pictures[1:],
    duration=round(1000 / options.fps),
    loop=0,
    quality=QUALITY,
    method=EFFORT,
)
