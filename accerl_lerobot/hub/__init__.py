# SPDX-License-Identifier: Apache-2.0
"""Push results to the Hugging Face Hub, and pull them."""
