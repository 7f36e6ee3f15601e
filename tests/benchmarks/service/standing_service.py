"""`hairstage serve` that stands still at one place of a capture, to be killed there.

`python -m benchmarks.service.standing_service FOLDER PLACE CALL serve …`: calls count while
FOLDER/armed exists; FOLDER/here is made at the CALL-th.
"""

from __future__ import annotations

import sys
from pathlib import Path

from standing import stand_still

from stage_service.cli import main

folder, place, call, *words = sys.argv[1:]
stand_still(place, int(call), Path(folder, "here").touch, Path(folder, "armed").exists)
sys.exit(main(words))
