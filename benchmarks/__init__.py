# SPDX-License-Identifier: Apache-2.0
"""The studies and measurements behind the documents: ``python -m benchmarks`` lists them."""
