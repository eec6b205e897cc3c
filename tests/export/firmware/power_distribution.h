float powerDistributionGetMaxThrust();
