# SPDX-License-Identifier: Apache-2.0
# clsplat on Intel's GPUs. Debian 12 has Intel's own driver, intel-opencl-icd; Debian 13 has not:
#   tools/release --build && docker build -f packaging/docker/intel.Dockerfile -t clsplat:intel .
#   docker run --rm --device /dev/dri -v "$PWD:/work" clsplat:intel train photos -o run
FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends intel-opencl-icd python3-venv \
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
