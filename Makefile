# Every target works in the active environment; `make install` fills it.
.DEFAULT_GOAL := help
.PHONY: help install test slow reproduce cards targets lint format docs

help: ## list the targets
	@grep -E '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

install: ## the package with its development tools, in the versions of constraints.txt
	pip install -c constraints.txt -e ".[dev]"

test: ## the quick tests
	pytest -n 2

slow: ## whole programs, and experiments in their small variants; FRICTIONZOO_DATA names the folder of real recordings
	pytest -m slow -n 2 -rs

reproduce: ## the experiments at full size, about an hour on two cores: checks their numbers and rewrites their tables
	python experiments/reproduce.py

cards: ## a card of each drive that the experiments measured, after `make reproduce`; LICENCE=ID says under which; BAM="FILE ..." those of BAM's parameter files besides
	python experiments/cards.py --licence "$(LICENCE)" $(if $(BAM),--bam $(BAM))

targets: ## exported drives in the programs that they are for: RUNS="FOLDER ..."; ENVIRONMENTS=FOLDER keeps the environments that it makes
	python benchmarks/targets.py $(RUNS) $(if $(ENVIRONMENTS),--environments $(ENVIRONMENTS))

lint: ## what CI checks besides tests
	ruff format --check
	ruff check
	pyright
	pyright --verifytypes frictionzoo --ignoreexternal | awk '/^Type completeness score/ { print; found = $$NF + 0 } END { exit !(found >= 95) }'

format: ## mend what can be mended
	ruff format
	ruff check --fix

docs: ## the documentation in site/, JSON schemas from types, pages of JSON files from them, those of plug-ins from docstrings
	python docs/write_schema.py
	python docs/write_result.py
	python docs/write_plugins.py
	NO_MKDOCS_2_WARNING=1 mkdocs build --strict
