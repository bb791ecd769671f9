# SPDX-License-Identifier: Apache-2.0
# clsplat on AMD's GPUs, by Mesa's Rusticl, which drives every card that Mesa drives:
#   tools/release --build && docker build -f packaging/docker/amd.Dockerfile -t clsplat:amd .
#   docker run --rm --device /dev/dri -v "$PWD:/work" clsplat:amd train photos -o run
FROM debian:trixie-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends mesa-opencl-icd python3-venv \
    && rm -rf /var/lib/apt/lists/*
# the package has Mesa's older driver, Clover, too, which would list each card a second time
RUN rm /etc/OpenCL/vendors/mesa.icd
COPY dist/clsplat-*.whl /tmp/
RUN python3 -m venv /opt/clsplat \
    && /opt/clsplat/bin/pip install --no-cache-dir /tmp/clsplat-*.whl \
    && rm /tmp/clsplat-*.whl
ENV PATH=/opt/clsplat/bin:$PATH RUSTICL_ENABLE=radeonsi
WORKDIR /work
RUN clsplat doctor
ENTRYPOINT ["clsplat"]
CMD ["doctor"]
