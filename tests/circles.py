"""A contract for import-linter: no module imports itself by way of others, not even for a type."""

from __future__ import annotations

from graphlib import CycleError, TopologicalSorter
from typing import Any

from importlinter import Contract, ContractCheck, output


class NoCircles(Contract):
    """All modules can be put in an order in which each imports earlier ones only."""

    def check(self, graph: Any, verbose: bool) -> ContractCheck:
        """Look for one circle."""
        del verbose
        imported = {one: graph.find_modules_directly_imported_by(one) for one in sorted(graph.modules)}
        try:
            TopologicalSorter(imported).prepare()
        except CycleError as error:
            return ContractCheck(kept=False, metadata={"circle": error.args[1][::-1]})
        return ContractCheck(kept=True)

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Show the circle."""
        output.print(" -> ".join(check.metadata["circle"]))
