"""What a person runs at a desk, without a server: the same samples, looked at, measured and compared.

simulate        `v2v-simulate`: one sample as a file
sample_set      `v2v-simulate --count`: samples as recordings
sample_flags    flags that name samples
remake          any sample of any stream, made in this process
preview         `v2v-preview`: what a recipe makes of videos, as pictures
motion          pictures without noise, and seeds whose cameras see motion
doctor          `v2v-doctor`: what is in the way on this machine, and in a corpus
tradeoff        `v2v-tradeoff`: speed, disk space and accuracy beside each other
fit             `v2v-fit`: a virtual camera from a recording
"""
