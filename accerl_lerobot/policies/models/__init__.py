# SPDX-License-Identifier: Apache-2.0
"""One file per LeRobot policy type: how its network is run; `policies/loading.py` has the table."""
