import torch

# As the service and its workers do: tests must not depend on how busy the other cores are.
torch.set_num_threads(1)
