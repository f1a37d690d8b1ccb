// What exposes colours in the loss, on the CPU and on a GPU.
#pragma once
#include "formulas.h"

namespace panolog {

constexpr float kToe = 0.055f;   // of sRGB, as in scene/images.py
constexpr float kHuber = 0.05f;  // of the range of colours: larger errors weigh less

// An exposed colour where the photograph is saturated: from 1 to what white becomes, all are as good as 1.
PANOLOG_HD float below_white(float exposed, float white) {
  const float more = exposed - (white > 1 ? white : 1);
  return exposed > 1 ? 1 + (more > 0 ? more : 0) : exposed;
}

}  // namespace panolog
