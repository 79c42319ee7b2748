"""Differentiable renderers behind one protocol, chosen by name. Only this package of the mapper imports
torch.
"""
