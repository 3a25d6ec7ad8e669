# SPDX-License-Identifier: Apache-2.0
"""``python -m accerl_lerobot.cli``, the same as ``accerl``."""

import sys

from accerl_lerobot.cli import main

sys.exit(main())
