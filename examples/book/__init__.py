"""The book: pages whose code blocks all run. `python examples/book` builds its site."""
