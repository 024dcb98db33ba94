# The trainer: networks, losses, evaluation, and the client that takes the stream. torch comes with CUDA, some gigabytes.
#   docker build -f deploy/trainer.Dockerfile -t v2v-trainer .
#   docker run --rm --init --gpus all --network host -v /scratch/runs:/runs v2v-trainer e2vid --connect tcp://127.0.0.1:5555 --out /runs/e2vid
# --init: see Dockerfile. SIGTERM ends the run after the present step and saves it; --resume /runs/e2vid/last.pt continues it.
FROM python:3.11-slim

RUN useradd --create-home --uid 1000 v2v && install -d -o v2v /runs
WORKDIR /opt/v2v
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY v2v_protocol v2v_protocol
COPY v2v_server v2v_server
COPY v2v_tools v2v_tools
COPY v2v_client v2v_client
COPY v2v_pictures v2v_pictures
COPY v2v_recordings v2v_recordings
COPY trainer trainer
RUN pip install --no-cache-dir --constraint constraints.txt '.[trainer]'

USER v2v
STOPSIGNAL SIGTERM
ENTRYPOINT ["v2v-train"]
CMD ["--help"]
