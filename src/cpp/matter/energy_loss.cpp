#include "matter/energy_loss.hpp"
