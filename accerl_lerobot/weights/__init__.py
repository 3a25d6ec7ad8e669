# SPDX-License-Identifier: Apache-2.0
"""Weights from the trainer to inference: shared memory on a machine, Ray's object store between machines."""
