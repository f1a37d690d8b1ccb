"""What a training loop of one's own uses: a model to begin with, views, growth strategies."""
