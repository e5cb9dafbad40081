"""The browser test bench: scenarios played and contested, and its report in one file."""
