# SPDX-License-Identifier: Apache-2.0
# clsplat on any processor of x86-64 or Arm that Debian's PoCL knows:
#   tools/release --build && docker build -f packaging/docker/cpu.Dockerfile -t clsplat:cpu .
#   docker run --rm -v "$PWD:/work" clsplat:cpu train photos -o run
FROM debian:trixie-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends pocl-opencl-icd python3-venv \
    && rm -rf /var/lib/apt/lists/*
COPY dist/clsplat-*.whl /tmp/
RUN python3 -m venv /opt/clsplat \
    && /opt/clsplat/bin/pip install --no-cache-dir /tmp/clsplat-*.whl \
    && rm /tmp/clsplat-*.whl
ENV PATH=/opt/clsplat/bin:$PATH
WORKDIR /work
RUN clsplat doctor
ENTRYPOINT ["clsplat"]
CMD ["doctor"]
