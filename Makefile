PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out
# what is compiled is kept, as tests start hundreds of processes; but nothing is compiled before it is first used
export PYTHONDONTWRITEBYTECODE :=
INSTALL := $(BIN)/pip install --quiet --no-compile --constraint constraints.txt
EXTRAS := plots,postgresql,recordings
HOST ?= 127.0.0.1
PORT ?= 8000

# tests that start several processes, a browser, a cluster or a database server: they come after the others
SEVERAL := $(addprefix tests/,$(addsuffix .py,clients/test_crash_test service/test_cluster service/test_live_page \
	clients/test_fleet clients/test_flood service/test_behind_a_proxy clients/test_trial clients/test_load_test \
	service/test_alone))
# tests that take time themselves: nothing else should run beside them
ALONE := $(addprefix tests/service/test_,$(addsuffix .py,adversary connections deadlines fair_shares gathering \
	overload shared_database stalls turns)) tests/service/store/test_faults.py \
	$(addprefix tests/clients/test_,$(addsuffix .py,adversary overload))

IN_TWO := -n 2 --dist loadfile --no-loadscope-reorder

.PHONY: help demo serve test fuzz lint format docs bench clean

help:
	@echo "make demo    start the gateway, drive a hostile fleet through it, show what came of it (WATCH=1: go on until Ctrl-C)"
	@echo "make serve   run the gateway at http://$(HOST):$(PORT)"
	@echo "make test    run the tests"
	@echo "make fuzz    24,000 fuzz cases against codec and gateway, some minutes"
	@echo "make lint    check style and types"
	@echo "make docs    build the documentation as a site, in build/site"
	@echo "make bench   measure frames per second and latency, briefly"

demo: $(VENV)/.installed
	$(BIN)/robosac demo --report $(OUT)/demo --force $(if $(WATCH),--watch)

serve: $(VENV)/.installed
	$(BIN)/robosac serve --host $(HOST) --port $(PORT)

test: $(VENV)/.installed-dev
	$(BIN)/pytest $(IN_TWO) $(patsubst %,--ignore %,$(SEVERAL) $(ALONE))
	$(BIN)/pytest $(IN_TWO) $(SEVERAL)
	$(BIN)/pytest $(ALONE)

fuzz: $(VENV)/.installed-dev
	ROBOSAC_FUZZ_CASES=4000 $(BIN)/pytest tests/fuzz

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --num-workers 2
	if [ -x $(BIN)/hadolint ]; then $(BIN)/hadolint docker/Dockerfile; fi

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

bench: $(VENV)/.installed
	$(BIN)/robosac load-test --seconds 4 --out $(OUT)/bench --force

$(VENV)/.created:
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "Python 3.11 or newer is needed; set PYTHON=..."'
	$(PYTHON) -m venv $(VENV)
	touch $@

$(VENV)/.installed: $(VENV)/.created pyproject.toml constraints.txt
	$(INSTALL) --editable '.[$(EXTRAS)]'
	touch $@

$(VENV)/.installed-dev: $(VENV)/.created pyproject.toml constraints.txt
	$(INSTALL) --editable '.[$(EXTRAS),dev]'
	touch $(VENV)/.installed $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(INSTALL) --editable '.[docs]'
	touch $@

clean:
	rm -rf $(VENV) $(OUT) build *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
