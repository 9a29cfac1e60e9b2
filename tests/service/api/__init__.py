"""A package, so that the application that its tests share (fixtures of scope `package`) ends with them."""
