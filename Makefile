# Every target works in the active environment; `make install` fills it.
.DEFAULT_GOAL := help
.PHONY: help install test slow reproduce cards targets lint format docs

help: ## list the targets
	@grep -E '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

install: ## install the package with its development tools, in the versions of constraints.txt
	pip install -c constraints.txt -e ".[dev]"

test: ## run the quick tests
	pytest -n 2

slow: ## run the slow tests: whole programs and small experiments; FRICTIONZOO_DATA names the folder of real recordings
	pytest -m slow -n 2 -rs

reproduce: ## run the experiments at full size (about an hour on two cores), check their numbers and rewrite their tables
	python experiments/reproduce.py

cards: ## write a card of each measured drive, after `make reproduce`; LICENCE=ID; BAM="FILE ..." adds those of BAM's parameter files
	python experiments/cards.py --licence "$(LICENCE)" $(if $(BAM),--bam $(BAM))

targets: ## run exported drives in their target programs: RUNS="FOLDER ..."; ENVIRONMENTS=FOLDER keeps the environments
	python benchmarks/targets.py $(RUNS) $(if $(ENVIRONMENTS),--environments $(ENVIRONMENTS))

lint: ## check style and types
	ruff format --check
	ruff check
	pyright
	pyright --verifytypes frictionzoo --ignoreexternal | awk '/^Type completeness score/ { print; found = $$NF + 0 } END { exit !(found >= 95) }'

format: ## format the code and apply safe fixes
	ruff format
	ruff check --fix

docs: ## write the JSON schemas and generated pages, and build the documentation in site/
	python docs/write_schema.py
	python docs/write_result.py
	python docs/write_plugins.py
	NO_MKDOCS_2_WARNING=1 mkdocs build --strict
