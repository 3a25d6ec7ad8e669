# SPDX-License-Identifier: Apache-2.0
"""Messages between workers: shared memory on a node, Ray between nodes."""
