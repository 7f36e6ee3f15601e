"""`python -m stage_service.cli` is `hairstage`."""

import sys

from stage_service.cli import main

sys.exit(main())
