# SPDX-License-Identifier: Apache-2.0
"""From trainer to inference: `publish(version, tensors)` on one side, `newest(than)` on the other."""
