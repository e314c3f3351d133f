(A plate of 120 mm by 80 mm with rounded ends, then a line across it.)
G21 G90 G17
M3 S1000
G0 X0 Y0
G1 X80 Y0 F6000
G3 X80 Y80 J40
G1 X0
G3 X0 Y0 J-40
G0 X0 Y40
G1 X80 F3000
M5
M30
