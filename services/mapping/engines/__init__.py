"""The engines of the mapper: those of common/engines, with optimisation on keyframes and carving."""
