# An image of the HTTP service, on CPUs by OpenVINO:
#   docker build -t lidar2pano .                                 # Apache-2.0 whole
#   docker build -t lidar2pano --build-arg STREETS=1 .           # with weights that are not for commercial use
#   docker run --rm -p 127.0.0.1:8360:8360 lidar2pano
# On an NVIDIA GPU (needs the NVIDIA Container Toolkit):
#   docker build -t lidar2pano:cuda --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu128 --build-arg ENGINE=torch .
#   docker run --rm --gpus all -p 127.0.0.1:8360:8360 lidar2pano:cuda
# Another command in the same image: docker run --rm -v "$PWD:/data" lidar2pano bulk /data/scans --out /data/panoramas
FROM python:3.11-slim

ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ARG ENGINE=openvino
ARG STREETS=

WORKDIR /build
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY packages ./packages
COPY src ./src
RUN pip install --no-cache-dir --constraint constraints.txt --index-url "$TORCH_INDEX" torch \
 && pip install --no-cache-dir --constraint constraints.txt '.[serve,fast,formats,recordings]' ${STREETS:+./packages/lidar2pano-streets} \
 && rm -rf /build/*

RUN useradd --system --create-home --uid 10001 lidar2pano
USER 10001
WORKDIR /home/lidar2pano
ENV LIDAR2PANO_ENGINE=$ENGINE LIDAR2PANO_CACHE=/home/lidar2pano/cache
# Compiles the networks for this processor; on another one the first request does, and the volume keeps the result.
RUN mkdir cache && lidar2pano demo --weights best --device cpu --out /tmp/demo && rm -r /tmp/demo
VOLUME /home/lidar2pano/cache
EXPOSE 8360
HEALTHCHECK --start-period=120s CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8360/health')"]
ENTRYPOINT ["lidar2pano"]
CMD ["serve", "--host", "0.0.0.0"]
