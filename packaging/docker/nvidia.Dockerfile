# SPDX-License-Identifier: Apache-2.0
# clsplat on NVIDIA's GPUs. The host has the display driver and NVIDIA's container toolkit, which brings the driver's libraries
# into the container at its start:
#   tools/release --build && docker build -f packaging/docker/nvidia.Dockerfile -t clsplat:nvidia .
#   docker run --rm --gpus all -v "$PWD:/work" clsplat:nvidia train photos -o run
FROM debian:trixie-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3-venv \
    && rm -rf /var/lib/apt/lists/*
# the toolkit brings libnvidia-opencl.so.1, and no .icd file
RUN mkdir -p /etc/OpenCL/vendors && echo libnvidia-opencl.so.1 > /etc/OpenCL/vendors/nvidia.icd
COPY dist/clsplat-*.whl /tmp/
RUN python3 -m venv /opt/clsplat \
    && /opt/clsplat/bin/pip install --no-cache-dir /tmp/clsplat-*.whl \
    && rm /tmp/clsplat-*.whl
ENV PATH=/opt/clsplat/bin:$PATH NVIDIA_DRIVER_CAPABILITIES=compute,utility NVIDIA_VISIBLE_DEVICES=all
WORKDIR /work
RUN clsplat doctor
ENTRYPOINT ["clsplat"]
CMD ["doctor"]
