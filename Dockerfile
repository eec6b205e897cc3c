# lemniscate on the CPU:
#   docker build --tag lemniscate .
#   docker run --rm --user "$(id -u)" --volume "$PWD/runs:/data/runs" lemniscate train ppo --env CartPole-v1 --run runs/cartpole
FROM python:3.12-slim-bookworm

# g++ is what torch.compile calls in long runs, swig what Box2D is built with; OSMesa draws MuJoCo without a screen.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends g++ libosmesa6 swig \
    && rm -rf /var/lib/apt/lists/*

ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1 MUJOCO_GL=osmesa

# torch in a layer of its own: it is large, and changes seldom.
RUN pip install "torch>=2.10" --index-url https://download.pytorch.org/whl/cpu

COPY . /src
RUN pip install "/src[box2d,classic-control,drone,envpool,mujoco,video]" && rm -rf /src

# Any user may be chosen with --user: caches go where everyone may write.
RUN useradd --uid 1000 lemniscate && mkdir --parents /data/runs && chmod 777 /data /data/runs
ENV HOME=/tmp USER=lemniscate
USER lemniscate
WORKDIR /data

ENTRYPOINT ["lemniscate"]
CMD ["--help"]
