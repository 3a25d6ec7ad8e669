# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks NAME --field=value …``, from the repository's root."""

from __future__ import annotations

import importlib
import sys
from contextlib import redirect_stdout
from typing import Any

from accerl_lerobot.cli import exit_code, help_asked, set_up_logging
from accerl_lerobot.cli.verbs import tell
from accerl_lerobot.config.help import help_text
from accerl_lerobot.config.parsing import parse
from accerl_lerobot.console import Console
from accerl_lerobot.engines.stopping import interrupted
from accerl_lerobot.errors import InputError
from benchmarks.async_vs_sync import BenchAsyncVsSyncConfig
from benchmarks.environment import BenchEnvironmentConfig
from benchmarks.faults import BenchFaultsConfig
from benchmarks.gpu import BenchGpuConfig
from benchmarks.latency import BenchLatencyConfig
from benchmarks.policy import BenchPolicyConfig
from benchmarks.samplers import BenchSamplersConfig
from benchmarks.scaling import BenchScalingConfig
from benchmarks.study import BenchStudyConfig
from benchmarks.third_party import BenchThirdPartyConfig
from benchmarks.throughput import BenchThroughputConfig
from benchmarks.transport import BenchTransportConfig

CONFIGS: dict[str, type[Any]] = {
    "environment": BenchEnvironmentConfig,
    "policy": BenchPolicyConfig,
    "samplers": BenchSamplersConfig,
    "throughput": BenchThroughputConfig,
    "study": BenchStudyConfig,
    "faults": BenchFaultsConfig,
    "async_vs_sync": BenchAsyncVsSyncConfig,
    "latency": BenchLatencyConfig,
    "scaling": BenchScalingConfig,
    "transport": BenchTransportConfig,
    "gpu": BenchGpuConfig,
    "third_party": BenchThirdPartyConfig,
}
"""Module with a function ``bench_NAME`` and a ``table`` of what it returns → its fields."""


def brief(name: str) -> str:
    """The first sentence of a benchmark's module, on one line, without its period."""
    doc = sys.modules[f"benchmarks.{name}"].__doc__ or ""
    return doc.partition("\n\n")[0].replace("\n", " ").rstrip(".")


def usage() -> str:
    """The list of all benchmarks."""
    lines = [f"  {name:14} {brief(name)}" for name in CONFIGS]
    return "\n".join(["usage: python -m benchmarks NAME [--field=value …]", "", *lines])


def run(name: str, rest: list[str]) -> int:
    """Runs a benchmark, or shows its help."""
    set_up_logging()
    if name not in CONFIGS:
        raise InputError("NAME", name, f"use one of {', '.join(CONFIGS)}")
    section = help_asked(rest)
    if section is not None:
        text = help_text(f"python -m benchmarks {name}", CONFIGS[name], brief(name), section)
        sys.stdout.write(f"{text}\n")
        return 0
    with interrupted():
        return measure(name, parse(CONFIGS[name], rest))


def measure(name: str, config: Any) -> int:
    """Run ``bench_NAME`` of the benchmark's module, and print its ``table`` and, for programs, its result."""
    module: Any = importlib.import_module(f"benchmarks.{name}")
    with redirect_stdout(sys.stderr):
        result = getattr(module, f"bench_{name}")(config)
    Console().rich.print(module.table(result))
    return tell(result)


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark of the command line; returns the exit code."""
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help", "help"):
        sys.stdout.write(f"{usage()}\n")
        return 0
    return exit_code("benchmarks", lambda: run(name, rest))


if __name__ == "__main__":
    sys.exit(main())
