"""The book: pages that teach, each of which runs. `python examples/book` makes its site."""
