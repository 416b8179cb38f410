# A CPU image of the HTTP service:
#   docker build -t lidar2pano .
#   docker run --rm -p 127.0.0.1:8360:8360 lidar2pano
# Another command in the same image: docker run --rm -v "$PWD:/data" lidar2pano bulk /data/scans --out /data/panoramas
FROM python:3.11-slim

WORKDIR /build
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY src ./src
RUN pip install --no-cache-dir --constraint constraints.txt --index-url https://download.pytorch.org/whl/cpu torch \
 && pip install --no-cache-dir --constraint constraints.txt '.[serve,fast,formats]' \
 && rm -rf /build/*

RUN useradd --system --create-home --uid 10001 lidar2pano
USER 10001
WORKDIR /home/lidar2pano
EXPOSE 8360
HEALTHCHECK --start-period=60s CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8360/health')"]
ENTRYPOINT ["lidar2pano"]
CMD ["serve", "--host", "0.0.0.0"]
