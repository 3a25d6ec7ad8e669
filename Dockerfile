# SPDX-License-Identifier: Apache-2.0
# docker build -t accerl .
# docker run --gpus all -v "$PWD/outputs:/accerl/outputs" accerl train --config_path=recipes/quickstart.yaml
# Without --gpus it runs on the CPU: PyTorch's package brings CUDA, and the driver comes from the host.
ARG BASE=python:3.12-slim-bookworm
FROM ${BASE}
# cmake and a compiler are for LIBERO; OpenGL's libraries are installed by the set-up.
RUN apt-get update \
    && apt-get install -y --no-install-recommends make cmake g++ git \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /accerl
COPY . .
RUN make setup
# Also the driver's OpenGL, so that simulators draw on the GPU.
ENV PATH="/accerl/.venv/bin:${PATH}" NVIDIA_DRIVER_CAPABILITIES=all
ENTRYPOINT ["accerl"]
