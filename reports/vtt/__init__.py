"""What reports say of visual target tracking alone: its paper's tables and figures, beside ours."""
