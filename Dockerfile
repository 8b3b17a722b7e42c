# The demo in a container:
#   docker build -t cadalign .
#   docker run --rm -v "$PWD/demo:/data/demo" cadalign
# Any other command: docker run --rm -v "$PWD:/data" cadalign fit photo.json
FROM python:3.12-slim

WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY cadalign cadalign
COPY datasets datasets
COPY render render
RUN pip install --no-cache-dir .

# Solvers are compiled into the image, in a folder that every user of the container may read.
ENV NUMBA_CACHE_DIR=/opt/cadalign
RUN cadalign doctor --compile && chmod -R a+rwX /opt/cadalign
WORKDIR /data
ENTRYPOINT ["cadalign"]
CMD ["demo", "--out", "demo"]
